//! A cell model's tables in the form the kernel reads.
//!
//! Per interval of SOC one row with the line of every quantity (value at SOC 0 and slope), so that one place gives all of
//! them without a division. Temperatures change slowly and are shared by cells: the rows of a temperature are made once
//! and kept until room is needed for another ([`KEPT`] of them).

use crate::cell::model::CellModel;
use crate::filter::lanes::Lanes;

/// Where a quantity's value is in a row; its slope (per unit of SOC) is behind it. Open-circuit voltage, V.
pub(super) const OCV_V: usize = 0;
/// Series resistance, ohm.
pub(super) const R0_OHM: usize = 2;
/// Voltage error, V; 0 where the model has none.
pub(super) const ERROR_V: usize = 4;
/// Resistance of the first branch, ohm; then its time constant, s, then the next branch's.
const BRANCHES: usize = 6;

/// Temperatures whose rows are kept: more than a block has lanes.
const KEPT: usize = 64;

/// Where branch `i`'s resistance is; its time constant follows.
pub(super) const fn branch(i: usize) -> usize {
    BRANCHES + 4 * i
}

/// The tables, `W` = 6 + 4 per branch.
#[derive(Debug, Clone)]
pub(super) struct Tables<const W: usize> {
    model: CellModel,
    /// Where one interval of SOC ends and the next begins.
    borders: Vec<f64>,
    /// Rows at the model's temperatures, temperature by temperature; the highest twice, so that each has an upper neighbour.
    nodes: Vec<[f64; W]>,
    /// Rows at the temperatures of `kept`.
    rows: Vec<[f64; W]>,
    kept: [f64; KEPT],
    /// The block of cells that needed each of them last.
    needed_by: [u64; KEPT],
    block: u64,
    /// Which makes room next, if the present block does not need it.
    next: usize,
    has_error: bool,
}

/// Places of L cells in the tables.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spot<const L: usize> {
    row: [usize; L],
    soc: Lanes<L>,
    /// SOC held at the ends of the tables.
    inside: Lanes<L>,
}

impl<const W: usize> Tables<W> {
    pub(super) fn new(model: &CellModel) -> Self {
        let temperatures = model.temperature_c.len();
        let nodes = (0..=temperatures)
            .flat_map(|t| (0..model.soc.len() - 1).map(move |s| row(model, t.min(temperatures - 1), s)));
        Self {
            borders: model.soc[1..model.soc.len() - 1].to_vec(),
            nodes: nodes.collect(),
            rows: vec![[0.0; W]; KEPT * (model.soc.len() - 1)],
            kept: [f64::NAN; KEPT],
            needed_by: [0; KEPT],
            block: 0,
            next: 0,
            has_error: model.voltage_error_v.is_some(),
            model: model.clone(),
        }
    }

    pub(super) fn has_error(&self) -> bool {
        self.has_error
    }

    /// The isotherms asked for from here on stay until this is called again; fewer than [`KEPT`] of them.
    #[inline(always)]
    pub(super) fn begin_block(&mut self) {
        self.block += 1;
    }

    /// Number of the rows of a temperature; `hint` is what it was the last time.
    #[inline(always)]
    pub(super) fn isotherm(&mut self, temperature_c: f64, hint: usize) -> usize {
        let slot = if self.kept[hint % KEPT] == temperature_c { hint % KEPT } else { self.find(temperature_c) };
        self.needed_by[slot] = self.block;
        slot
    }

    /// The rows of a temperature are found among the kept ones, or made.
    #[cold]
    #[inline(never)]
    fn find(&mut self, temperature_c: f64) -> usize {
        if let Some(found) = self.kept.iter().position(|&kept| kept == temperature_c) {
            return found;
        }
        while self.needed_by[self.next] == self.block {
            self.next = (self.next + 1) % KEPT;
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
        self.borders.len() + 1
    }

    /// The places of L states of charge.
    #[inline(always)]
    pub(super) fn spot<const L: usize>(&self, isotherms: &[usize; L], soc: Lanes<L>) -> Spot<L> {
        let mut interval = [0_u64; L];
        for &border in &self.borders {
            for (interval, soc) in interval.iter_mut().zip(soc.0) {
                *interval += u64::from(soc >= border);
            }
        }
        let mut row = [0; L];
        for lane in 0..L {
            row[lane] = isotherms[lane] * self.intervals() + interval[lane] as usize;
        }
        Spot { row, soc, inside: soc.at_least(0.0).at_most(1.0) }
    }

    /// The places of L states of charge, and of those `reach` above and below.
    #[inline(always)]
    pub(super) fn spots<const L: usize>(&self, isotherms: &[usize; L], soc: Lanes<L>, reach: Lanes<L>) -> [Spot<L>; 3] {
        [self.spot(isotherms, soc), self.spot(isotherms, soc + reach), self.spot(isotherms, soc - reach)]
    }

    /// Values at SOC 0 and slopes of the quantity at `at` and the one behind it.
    #[inline(always)]
    fn lines<const L: usize>(&self, spot: &Spot<L>, at: usize) -> [Lanes<L>; 4] {
        let [mut a, mut b, mut c, mut d] = [[0.0; L]; 4];
        for lane in 0..L {
            let row = &self.rows[spot.row[lane]];
            (a[lane], b[lane], c[lane], d[lane]) = (row[at], row[at + 1], row[at + 2], row[at + 3]);
        }
        [Lanes(a), Lanes(b), Lanes(c), Lanes(d)]
    }

    /// Open-circuit voltage, V, its slope, V per unit of SOC, and series resistance, ohm.
    #[inline(always)]
    pub(super) fn ocv_and_r0<const L: usize>(&self, spot: &Spot<L>) -> (Lanes<L>, Lanes<L>, Lanes<L>) {
        let [ocv_v, slope_v, r0_ohm, per_soc] = self.lines(spot, OCV_V);
        (ocv_v + slope_v * spot.soc, slope_v, r0_ohm + per_soc * spot.inside)
    }

    /// Resistance, ohm, and time constant, s, of a branch.
    #[inline(always)]
    pub(super) fn branch<const L: usize>(&self, spot: &Spot<L>, i: usize) -> (Lanes<L>, Lanes<L>) {
        let [ohm, ohm_per_soc, tau_s, tau_per_soc] = self.lines(spot, branch(i));
        (ohm + ohm_per_soc * spot.inside, tau_s + tau_per_soc * spot.inside)
    }

    /// One quantity, held at the ends of the tables.
    #[inline(always)]
    pub(super) fn one<const L: usize>(&self, spot: &Spot<L>, at: usize) -> Lanes<L> {
        let [mut start, mut slope] = [[0.0; L]; 2];
        for lane in 0..L {
            let row = &self.rows[spot.row[lane]];
            (start[lane], slope[lane]) = (row[at], row[at + 1]);
        }
        Lanes(start) + Lanes(slope) * spot.inside
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
