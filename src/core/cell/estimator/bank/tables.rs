//! A cell model's tables in the form the kernel reads.
//!
//! Per interval of SOC one row with the line of every quantity (value at SOC 0 and slope), so that one place gives all of
//! them without a division. Temperatures change slowly and are shared by cells: the rows of a temperature are made once
//! and kept until room is needed for another ([`KEPT`] of them). A cell stays in its interval for thousands of steps: the
//! lines it is on are kept beside its state ([`Around`]), lane by lane, and what is left of a look-up is a comparison.
//! What is kept depends on temperature and SOC alone, so results do not depend on what was kept.
//!
//! In: states of charge, degrees C. Out: V, ohm, s. What is no number gives values that are none, in its own lane alone: such
//! a step is not usable.

use crate::cell::model::CellModel;
use crate::filter::simd::Lanes;

/// Where a quantity's value is in a row; its slope (per unit of SOC) is behind it. Open-circuit voltage, V.
pub(super) const OCV_V: usize = 0;
/// Series resistance, ohm.
pub(super) const R0_OHM: usize = 2;
/// Voltage error, V; 0 where the model has none.
pub(super) const ERROR_V: usize = 4;
/// Resistance of the first branch, ohm; then its time constant, s, then the next branch's.
const BRANCHES: usize = 6;

/// Temperatures whose rows are kept: more than packs have sensors. With more, rows are made again, and results stay.
const KEPT: usize = 64;

/// Where branch `i`'s resistance is; its time constant follows.
pub(super) const fn branch(i: usize) -> usize {
    BRANCHES + 4 * i
}

/// The tables, `W` = 6 + 4 per branch.
#[derive(Debug, Clone)]
pub(super) struct Tables<const W: usize> {
    model: CellModel,
    /// Where each interval of SOC ends and the next begins; beyond the ends of the tables the outer ones go on.
    borders: Vec<f64>,
    /// Rows at the model's temperatures, temperature by temperature; the highest twice, so that each has an upper neighbour.
    nodes: Vec<[f64; W]>,
    /// Rows at the temperatures of `kept`.
    rows: Vec<[f64; W]>,
    kept: [f64; KEPT],
    /// Which makes room next.
    next: usize,
    has_error: bool,
}

/// The lines of L cells at three places each, about its SOC and on both sides: kept from step to step, as a cell stays in
/// an interval for thousands of them.
#[derive(Debug, Clone)]
pub(super) struct Around<const L: usize, const W: usize> {
    temperature_c: [f64; L],
    /// Where the rows of the temperatures were.
    isotherms: [usize; L],
    places: [Lines<L, W>; 3],
}

/// The lines of L cells at one place each.
#[derive(Debug, Clone)]
struct Lines<const L: usize, const W: usize> {
    interval: [usize; L],
    /// Where the intervals begin.
    from: Lanes<L>,
    /// Where the next ones do.
    to: Lanes<L>,
    row: [Lanes<L>; W],
}

/// Lines of L cells, and where on them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spot<'a, const L: usize, const W: usize> {
    row: &'a [Lanes<L>; W],
    soc: Lanes<L>,
    /// SOC held at the ends of the tables.
    inside: Lanes<L>,
}

impl<const W: usize> Tables<W> {
    pub(super) fn new(model: &CellModel) -> Self {
        let temperatures = model.temperature_c.len();
        let intervals = model.soc.len() - 1;
        let nodes =
            (0..=temperatures).flat_map(|t| (0..intervals).map(move |s| row(model, t.min(temperatures - 1), s)));
        let mut borders = model.soc.clone();
        (borders[0], borders[intervals]) = (f64::NEG_INFINITY, f64::INFINITY);
        Self {
            borders,
            nodes: nodes.collect(),
            rows: vec![[0.0; W]; KEPT * intervals],
            kept: [f64::NAN; KEPT],
            next: 0,
            has_error: model.voltage_error_v.is_some(),
            model: model.clone(),
        }
    }

    pub(super) fn has_error(&self) -> bool {
        self.has_error
    }

    /// Number of the rows of a temperature, until the next is asked for; `hint` is what it was the last time.
    fn isotherm(&mut self, temperature_c: f64, hint: usize) -> usize {
        if self.kept[hint % KEPT] == temperature_c { hint % KEPT } else { self.find(temperature_c) }
    }

    /// The rows of a temperature are found among the kept ones, or made.
    #[cold]
    #[inline(never)]
    fn find(&mut self, temperature_c: f64) -> usize {
        if let Some(found) = self.kept.iter().position(|&kept| kept == temperature_c) {
            return found;
        }
        let slot = self.next;
        self.next = (slot + 1) % KEPT;
        self.kept[slot] = temperature_c;
        let place = self.model.row(temperature_c);
        let mut along = [place.along_t; W];
        for i in std::iter::once(R0_OHM).chain((0..self.model.branches.len()).map(branch)) {
            (along[i], along[i + 1]) = (place.along_arrhenius, place.along_arrhenius);
        }
        let intervals = self.intervals();
        let low = &self.nodes[place.t * intervals..][..intervals];
        let high = &self.nodes[(place.t + 1) * intervals..][..intervals];
        for ((row, low), high) in self.rows[slot * intervals..].iter_mut().zip(low).zip(high) {
            *row = std::array::from_fn(|i| low[i] + along[i] * (high[i] - low[i]));
        }
        slot
    }

    fn intervals(&self) -> usize {
        self.borders.len() - 1
    }

    /// The interval of a state of charge.
    fn interval(&self, soc: f64) -> usize {
        self.borders[1..self.intervals()].iter().filter(|&&border| soc >= border).count()
    }

    /// Takes the lines of `around` at these temperatures.
    #[inline(always)]
    pub(super) fn warm<const L: usize>(&mut self, around: &mut Around<L, W>, temperature_c: &Lanes<L>) {
        let same = (0..L).fold(true, |same, lane| same & (around.temperature_c[lane] == temperature_c.0[lane]));
        if !same {
            self.follow_temperatures(around, temperature_c);
        }
    }

    #[cold]
    #[inline(never)]
    fn follow_temperatures<const L: usize>(&mut self, around: &mut Around<L, W>, temperature_c: &Lanes<L>) {
        for lane in 0..L {
            if around.temperature_c[lane] != temperature_c.0[lane] {
                around.temperature_c[lane] = temperature_c.0[lane];
                let isotherm = self.isotherm(temperature_c.0[lane], around.isotherms[lane]);
                around.isotherms[lane] = isotherm;
                around.places.iter_mut().for_each(|lines| self.copy(isotherm, lines, lane));
            }
        }
    }

    /// The places of L states of charge, and of those `reach` above and below, at the temperatures of the last
    /// [`Self::warm`].
    #[inline(always)]
    pub(super) fn spots<'a, const L: usize>(
        &mut self,
        around: &'a mut Around<L, W>,
        soc: Lanes<L>,
        reach: Lanes<L>,
    ) -> [Spot<'a, L, W>; 3] {
        let all = [soc, soc + reach, soc - reach];
        let mut same = true;
        for (lines, soc) in around.places.iter().zip(&all) {
            same = (0..L).fold(same, |same, lane| same & lines.holds(soc, lane));
        }
        if !same {
            self.follow_charges(around, &all);
        }
        let [a, b, c] = &around.places;
        [Spot::new(a, all[0]), Spot::new(b, all[1]), Spot::new(c, all[2])]
    }

    #[cold]
    #[inline(never)]
    fn follow_charges<const L: usize>(&mut self, around: &mut Around<L, W>, all: &[Lanes<L>; 3]) {
        for (lines, soc) in around.places.iter_mut().zip(all) {
            for lane in 0..L {
                if !lines.holds(soc, lane) {
                    let interval = self.interval(soc.0[lane]);
                    lines.interval[lane] = interval;
                    (lines.from.0[lane], lines.to.0[lane]) = (self.borders[interval], self.borders[interval + 1]);
                    let isotherm = self.isotherm(around.temperature_c[lane], around.isotherms[lane]);
                    around.isotherms[lane] = isotherm;
                    self.copy(isotherm, lines, lane);
                }
            }
        }
    }

    /// Copies the lines of a lane's interval.
    fn copy<const L: usize>(&self, isotherm: usize, lines: &mut Lines<L, W>, lane: usize) {
        let row = &self.rows[isotherm * self.intervals() + lines.interval[lane]];
        lines.row.iter_mut().zip(row).for_each(|(lanes, value)| lanes.0[lane] = *value);
    }

    /// Open-circuit voltages at other states of charge, V.
    #[inline(never)]
    pub(super) fn ocv_v<const L: usize>(&mut self, around: &Around<L, W>, soc: &Lanes<L>) -> Lanes<L> {
        Lanes(std::array::from_fn(|lane| {
            let isotherm = self.isotherm(around.temperature_c[lane], around.isotherms[lane]);
            let row = &self.rows[isotherm * self.intervals() + self.interval(soc.0[lane])];
            row[OCV_V] + row[OCV_V + 1] * soc.0[lane]
        }))
    }
}

impl<const L: usize, const W: usize> Around<L, W> {
    /// Of no temperature yet.
    pub(super) fn new(tables: &Tables<W>) -> Self {
        let zero = Lanes::splat(0.0);
        let lines = Lines {
            interval: [0; L],
            from: Lanes::splat(tables.borders[0]),
            to: Lanes::splat(tables.borders[1]),
            row: [zero; W],
        };
        Self { temperature_c: [f64::NAN; L], isotherms: [0; L], places: [lines.clone(), lines.clone(), lines] }
    }
}

impl<const L: usize, const W: usize> Lines<L, W> {
    /// Whether they are those of a lane's state of charge.
    #[inline(always)]
    fn holds(&self, soc: &Lanes<L>, lane: usize) -> bool {
        (soc.0[lane] >= self.from.0[lane]) & (soc.0[lane] < self.to.0[lane])
    }
}

impl<'a, const L: usize, const W: usize> Spot<'a, L, W> {
    #[inline(always)]
    fn new(lines: &'a Lines<L, W>, soc: Lanes<L>) -> Self {
        Self { row: &lines.row, soc, inside: soc.at_least(0.0).at_most(1.0) }
    }

    /// Open-circuit voltage, V, its slope, V per unit of SOC, and series resistance, ohm.
    #[inline(always)]
    pub(super) fn ocv_and_r0(&self) -> (Lanes<L>, Lanes<L>, Lanes<L>) {
        let slope_v = self.row[OCV_V + 1];
        (self.row[OCV_V] + slope_v * self.soc, slope_v, self.one(R0_OHM))
    }

    /// Resistance, ohm, and time constant, s, of a branch.
    #[inline(always)]
    pub(super) fn branch(&self, i: usize) -> (Lanes<L>, Lanes<L>) {
        (self.one(branch(i)), self.one(branch(i) + 2))
    }

    /// One quantity, held at the ends of the tables.
    #[inline(always)]
    pub(super) fn one(&self, at: usize) -> Lanes<L> {
        self.row[at] + self.row[at + 1] * self.inside
    }
}

fn row<const W: usize>(model: &CellModel, t: usize, s: usize) -> [f64; W] {
    let mut row = [0.0; W];
    let mut set = |place: usize, value: &dyn Fn(usize) -> f64| {
        let slope = (value(s + 1) - value(s)) / (model.soc[s + 1] - model.soc[s]);
        (row[place], row[place + 1]) = (value(s) - slope * model.soc[s], slope);
    };
    set(OCV_V, &|s| model.ocv_v.values[t][s]);
    set(R0_OHM, &|s| model.r0_ohm.values[t][s]);
    if let Some(error_v) = &model.voltage_error_v {
        set(ERROR_V, &|s| error_v.values[t][s]);
    }
    for (i, b) in model.branches.iter().enumerate() {
        set(branch(i), &|s| b.r_ohm.values[t][s]);
        set(branch(i) + 2, &|s| b.r_ohm.values[t][s] * b.c_farad.values[t][s]);
    }
    row
}
