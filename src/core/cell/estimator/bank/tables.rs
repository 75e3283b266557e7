//! Holds a cell model's tables in the form that the filter's vector code ([`super::kernel`]) reads.
//!
//! A row has a line (value at SOC 0, and slope) for every quantity in one SOC interval, so one look-up gives all
//! quantities without a division. Temperatures change slowly, and several cells share a temperature. The rows of a
//! temperature are therefore computed once and kept until their slot is reused ([`MAX_ISOTHERMS`]).
//!
//! A cell stays in its SOC interval for thousands of steps. Its lines are therefore cached ([`LineCache`]), and a
//! look-up is a single comparison. The results do not depend on the state of the cache.
//!
//! In: SOC, temperature (degrees C), capacity (Ah). Out: V, ohm, s. A NaN in one lane (one cell) gives a NaN voltage in
//! this lane only, and the step is then not usable.

use crate::cell::aged_ocv::{MIXES, OffsetLine};
use crate::cell::model::CellModel;
use crate::filter::simd::Lanes;

/// Index of the open-circuit voltage (V) in a row. Each value is followed by its slope (per unit of SOC).
pub(super) const OCV_V: usize = 0;
/// Index of the change of the open-circuit voltage with the capacity (V per Ah); the change is 0 if the curve does not
/// age. The changes of the open-circuit voltage by each mix (V) have the next indices. A mix states how uncertain the
/// aged curve is ([`crate::cell::aged_ocv`]).
pub(super) const OCV_PER_AH: usize = 2;
pub(super) const R0_OHM: usize = OCV_PER_AH + 2 + 2 * MIXES;
/// Index of the voltage error (V); 0 if the model states no error.
pub(super) const ERROR_V: usize = R0_OHM + 2;
const BRANCHES: usize = ERROR_V + 2;

/// Number of temperatures with cached rows. A pack usually has fewer temperature sensors.
const MAX_ISOTHERMS: usize = 64;

/// Index of the resistance (ohm) of branch `i`; its time constant (s) follows.
pub(super) const fn branch(i: usize) -> usize {
    BRANCHES + 4 * i
}

/// The tables. A row has `W` numbers: 12, and 4 more per branch.
#[derive(Debug, Clone)]
pub(super) struct Tables<const W: usize> {
    model: CellModel,
    /// Borders between intervals of SOC; the outer intervals are unbounded.
    borders: Vec<f64>,
    /// Rows at the model's temperatures, temperature by temperature. The last rows are stored twice, so that each
    /// temperature has an upper neighbour.
    nodes: Vec<[f64; W]>,
    rows: Vec<[f64; W]>,
    temperatures_c: [f64; MAX_ISOTHERMS],
    next: usize,
    has_error: bool,
}

/// Cached lines of L cells at three points each: at the SOC and on both sides of it.
#[derive(Debug, Clone)]
pub(super) struct LineCache<const L: usize, const W: usize> {
    temperature_c: [f64; L],
    /// Slot in which the rows of each lane's temperature were last found.
    isotherms: [usize; L],
    capacity_ah: [f64; L],
    places: [CachedLines<L, W>; 3],
}

/// Cached lines of L cells at one point each.
#[derive(Debug, Clone)]
struct CachedLines<const L: usize, const W: usize> {
    interval: [usize; L],
    from: Lanes<L>,
    to: Lanes<L>,
    row: [Lanes<L>; W],
    /// The part of the open-circuit voltage's line that depends on the capacity; already included in `row`.
    offset_v: [Lanes<L>; 2],
}

#[derive(Debug, Clone, Copy)]
pub(super) struct TablePoint<'a, const L: usize, const W: usize> {
    row: &'a [Lanes<L>; W],
    soc: Lanes<L>,
    /// SOC limited to the range of the tables.
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
            rows: vec![[0.0; W]; MAX_ISOTHERMS * intervals],
            temperatures_c: [f64::NAN; MAX_ISOTHERMS],
            next: 0,
            has_error: model.voltage_error_v.is_some(),
            model: model.clone(),
        }
    }

    pub(super) fn has_error(&self) -> bool {
        self.has_error
    }

    /// Slot of the rows of a temperature, valid until the next call. `hint` is the slot that the last call for the same
    /// lane returned.
    fn isotherm(&mut self, temperature_c: f64, hint: usize) -> usize {
        if self.temperatures_c[hint % MAX_ISOTHERMS] == temperature_c {
            hint % MAX_ISOTHERMS
        } else {
            self.find(temperature_c)
        }
    }

    #[cold]
    #[inline(never)]
    fn find(&mut self, temperature_c: f64) -> usize {
        if let Some(found) = self.temperatures_c.iter().position(|&cached_c| cached_c == temperature_c) {
            return found;
        }
        let slot = self.next;
        self.next = (slot + 1) % MAX_ISOTHERMS;
        self.temperatures_c[slot] = temperature_c;
        let position = self.model.temperature_position(temperature_c);
        let mut along = [position.along_t; W];
        for i in std::iter::once(R0_OHM).chain((0..self.model.branches.len()).map(branch)) {
            (along[i], along[i + 1]) = (position.along_arrhenius, position.along_arrhenius);
        }
        let intervals = self.intervals();
        let low = &self.nodes[position.t * intervals..][..intervals];
        let high = &self.nodes[(position.t + 1) * intervals..][..intervals];
        for ((row, low), high) in self.rows[slot * intervals..].iter_mut().zip(low).zip(high) {
            *row = std::array::from_fn(|i| low[i] + along[i] * (high[i] - low[i]));
        }
        slot
    }

    fn intervals(&self) -> usize {
        self.borders.len() - 1
    }

    fn interval(&self, soc: f64) -> usize {
        self.borders[1..self.intervals()].iter().filter(|&&border| soc >= border).count()
    }

    #[inline(always)]
    pub(super) fn refresh_temperatures<const L: usize>(
        &mut self,
        cache: &mut LineCache<L, W>,
        temperature_c: &Lanes<L>,
    ) {
        let same = (0..L).fold(true, |same, lane| same & (cache.temperature_c[lane] == temperature_c.0[lane]));
        if !same {
            self.reload_temperatures(cache, temperature_c);
        }
    }

    #[cold]
    #[inline(never)]
    fn reload_temperatures<const L: usize>(&mut self, cache: &mut LineCache<L, W>, temperature_c: &Lanes<L>) {
        for lane in 0..L {
            if cache.temperature_c[lane] != temperature_c.0[lane] {
                cache.temperature_c[lane] = temperature_c.0[lane];
                let isotherm = self.isotherm(temperature_c.0[lane], cache.isotherms[lane]);
                cache.isotherms[lane] = isotherm;
                cache.places.iter_mut().for_each(|lines| self.copy(isotherm, lines, lane));
            }
        }
    }

    /// Updates the lines in `cache` to the open-circuit curves of these capacities (Ah). The capacities change only at
    /// the end of a charge or discharge.
    #[inline(always)]
    pub(super) fn refresh_capacities<const L: usize>(&mut self, cache: &mut LineCache<L, W>, capacity_ah: &Lanes<L>) {
        let same = (0..L).fold(true, |same, lane| same & (cache.capacity_ah[lane] == capacity_ah.0[lane]));
        if !same {
            self.reload_capacities(cache, capacity_ah);
        }
    }

    #[cold]
    #[inline(never)]
    fn reload_capacities<const L: usize>(&mut self, cache: &mut LineCache<L, W>, capacity_ah: &Lanes<L>) {
        for lane in 0..L {
            cache.capacity_ah[lane] = capacity_ah.0[lane];
            let isotherm = self.isotherm(cache.temperature_c[lane], cache.isotherms[lane]);
            cache.isotherms[lane] = isotherm;
            for lines in &mut cache.places {
                self.age(capacity_ah.0[lane], lines, lane);
                self.copy(isotherm, lines, lane);
            }
        }
    }

    /// Table points at L states of charge, and at the states of charge `reach` above and `reach` below each of them.
    /// The temperatures come from the last call of [`Self::refresh_temperatures`].
    #[inline(always)]
    pub(super) fn table_points<'a, const L: usize>(
        &mut self,
        cache: &'a mut LineCache<L, W>,
        soc: Lanes<L>,
        reach: Lanes<L>,
    ) -> [TablePoint<'a, L, W>; 3] {
        let all = [soc, soc + reach, soc - reach];
        let mut same = true;
        for (lines, soc) in cache.places.iter().zip(&all) {
            same = (0..L).fold(same, |same, lane| same & lines.holds(soc, lane));
        }
        if !same {
            self.reload_intervals(cache, &all);
        }
        let [a, b, c] = &cache.places;
        [TablePoint::new(a, all[0]), TablePoint::new(b, all[1]), TablePoint::new(c, all[2])]
    }

    #[cold]
    #[inline(never)]
    fn reload_intervals<const L: usize>(&mut self, cache: &mut LineCache<L, W>, all: &[Lanes<L>; 3]) {
        for (lines, soc) in cache.places.iter_mut().zip(all) {
            for lane in 0..L {
                if !lines.holds(soc, lane) {
                    let interval = self.interval(soc.0[lane]);
                    lines.interval[lane] = interval;
                    (lines.from.0[lane], lines.to.0[lane]) = (self.borders[interval], self.borders[interval + 1]);
                    let isotherm = self.isotherm(cache.temperature_c[lane], cache.isotherms[lane]);
                    cache.isotherms[lane] = isotherm;
                    self.age(cache.capacity_ah[lane], lines, lane);
                    self.copy(isotherm, lines, lane);
                }
            }
        }
    }

    /// Computes the lines of a lane that change with ageing, for a cell of this capacity (Ah).
    fn age<const L: usize>(&self, capacity_ah: f64, lines: &mut CachedLines<L, W>, lane: usize) {
        let OffsetLine { offset_v, per_ah_v, mixes_v } =
            self.model.aged_ocv.line(&self.model.soc, lines.interval[lane], capacity_ah);
        for k in 0..2 {
            lines.offset_v[k].0[lane] = offset_v.0[k];
            for (i, change_v) in std::iter::once(&per_ah_v).chain(&mixes_v).enumerate() {
                lines.row[OCV_PER_AH + 2 * i + k].0[lane] = change_v.0[k];
            }
        }
    }

    fn copy<const L: usize>(&self, isotherm: usize, lines: &mut CachedLines<L, W>, lane: usize) {
        let row = &self.rows[isotherm * self.intervals() + lines.interval[lane]];
        for k in 0..2 {
            lines.row[OCV_V + k].0[lane] = row[OCV_V + k] + lines.offset_v[k].0[lane];
        }
        lines.row[R0_OHM..].iter_mut().zip(&row[R0_OHM..]).for_each(|(lanes, value)| lanes.0[lane] = *value);
    }
}

impl<const L: usize, const W: usize> LineCache<L, W> {
    pub(super) fn new(tables: &Tables<W>) -> Self {
        let zero = Lanes::splat(0.0);
        let lines = CachedLines {
            interval: [0; L],
            from: Lanes::splat(tables.borders[0]),
            to: Lanes::splat(tables.borders[1]),
            row: [zero; W],
            offset_v: [zero; 2],
        };
        Self {
            temperature_c: [f64::NAN; L],
            isotherms: [0; L],
            capacity_ah: [f64::NAN; L],
            places: [lines.clone(), lines.clone(), lines],
        }
    }
}

impl<const L: usize, const W: usize> CachedLines<L, W> {
    #[inline(always)]
    fn holds(&self, soc: &Lanes<L>, lane: usize) -> bool {
        (soc.0[lane] >= self.from.0[lane]) & (soc.0[lane] < self.to.0[lane])
    }
}

impl<'a, const L: usize, const W: usize> TablePoint<'a, L, W> {
    #[inline(always)]
    fn new(lines: &'a CachedLines<L, W>, soc: Lanes<L>) -> Self {
        Self { row: &lines.row, soc, inside: soc.at_least(0.0).at_most(1.0) }
    }

    #[inline(always)]
    pub(super) fn ocv_and_r0(&self) -> (Lanes<L>, Lanes<L>, Lanes<L>) {
        let slope_v = self.row[OCV_V + 1];
        (self.row[OCV_V] + slope_v * self.soc, slope_v, self.one(R0_OHM))
    }

    /// Changes of the open-circuit voltage: with the capacity (V per Ah), and by each mix (V).
    #[inline(always)]
    pub(super) fn ocv_changes(&self) -> [Lanes<L>; 1 + MIXES] {
        std::array::from_fn(|i| self.row[OCV_PER_AH + 2 * i] + self.row[OCV_PER_AH + 2 * i + 1] * self.soc)
    }

    #[inline(always)]
    pub(super) fn branch(&self, i: usize) -> (Lanes<L>, Lanes<L>) {
        (self.one(branch(i)), self.one(branch(i) + 2))
    }

    /// The quantity at index `at`; constant beyond the ends of the tables.
    #[inline(always)]
    pub(super) fn one(&self, at: usize) -> Lanes<L> {
        self.row[at] + self.row[at + 1] * self.inside
    }
}

fn row<const W: usize>(model: &CellModel, t: usize, s: usize) -> [f64; W] {
    let mut row = [0.0; W];
    let mut set = |index: usize, value: &dyn Fn(usize) -> f64| {
        let slope = (value(s + 1) - value(s)) / (model.soc[s + 1] - model.soc[s]);
        (row[index], row[index + 1]) = (value(s) - slope * model.soc[s], slope);
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
