//! Derives findings (probable faults) from the states of the cells, and decides when to report and when to withdraw a
//! finding. The detector judges the cells at the end of each row (sums of a few minutes of samples). A BMS *bleeds* a
//! cell when it discharges the cell through a balancing resistor.

use super::CellFaultDetector;
use crate::cell_faults::difference::{CAPACITY, CHANNEL, CONTACT, Jump, LEAK, RESISTANCE, SOC, STATES};
use crate::cell_faults::fault::{self, CellFault, CellFaultKind, OUTLIER, REPORTED, WITHDRAWN};
use crate::filter::{ScalarGaussian, normal_cdf};
use crate::quantity::{CellIndex, DAY_S, Timestamp};

/// If the capacities of neighbouring cells have risen within this time of each other (s), the cells count as one
/// replaced module. A single cell with a higher capacity is reported only after this time.
const SAME_MODULE_S: f64 = 3.0 * DAY_S;
/// The size of a fault is known if its standard deviation is at most this multiple of the fault's limit. Each kind of
/// fault has a limit, above which it is reported.
const KNOWN_LIMITS: f64 = 2.0;

/// If the probability of a leak is at least this, the leak explains a charge difference.
const LIKELY: f64 = 0.9;
/// A capacity difference is known if its standard deviation is at most this fraction.
const KNOWN_CAPACITY_STD: f64 = 0.05;
/// A difference in charge must exceed its limit at these SOC values of the pack. Otherwise, the cell has another
/// capacity.
const CHARGE_AT: [f64; 2] = [0.2, 0.9];

/// Until a fault is a finding, the shown size is at most this fraction of the fault's limit.
const BELOW_LIMIT: f64 = 0.99;

/// If a cell's SOC differs from the other cells' SOC by at least this much, four faults cannot be judged: contact,
/// resistance, channel offset and higher capacity.
const TOO_FAR: f64 = 0.1;

#[derive(Debug, Clone, Copy)]
struct Judgement {
    kind: CellFaultKind,
    size: ScalarGaussian,
    probability: f64,
    /// Whether the cell's SOC is close enough to the other cells' SOC to judge this kind of fault.
    is_comparable: bool,
}

/// Median over the cells, and a robust standard deviation computed from the median absolute deviation.
pub(super) struct Population {
    pub(super) middle: f64,
    pub(super) std: f64,
}

impl Population {
    pub(super) fn of(of_cells: impl Iterator<Item = f64>) -> Self {
        // Allocates once. `collect` would allocate only the lower bound of the size hint, which is 0 for a filter.
        let mut values: Vec<f64> = Vec::with_capacity(of_cells.size_hint().1.unwrap_or_default());
        values.extend(of_cells);
        values.sort_by(f64::total_cmp);
        let median = |sorted: &[f64]| {
            if sorted.is_empty() { 0.0 } else { 0.5 * (sorted[(sorted.len() - 1) / 2] + sorted[sorted.len() / 2]) }
        };
        let middle = median(&values);
        values.iter_mut().for_each(|value| *value = (*value - middle).abs());
        values.sort_by(f64::total_cmp);
        Self { middle, std: 1.4826 * median(&values) }
    }
}

impl CellFaultDetector {
    pub(super) fn population(&self, state: usize) -> Population {
        let compared = self.cells.iter().filter(|cell| cell.is_compared);
        Population::of(compared.map(|cell| cell.difference.state(state).mean))
    }

    /// Judges all cells. `bled_slope_v`: slope of the open-circuit curve (V per unit of SOC) at the SOC at which the
    /// BMS bleeds cells; `None` if the BMS bleeds no cells.
    pub(super) fn judge(&mut self, time: Timestamp, bled_slope_v: Option<f64>) {
        self.is_balanced = bled_slope_v.is_some();
        let lowest = bled_slope_v.and_then(|slope_v| self.clearly_lowest(slope_v));
        if let Some(cell) = lowest.filter(|cell| self.lowest != lowest && !self.cells[*cell].bleed.timer.has_bits) {
            self.cells[cell].difference.watch_leak();
        }
        self.lowest = lowest;
        for index in 0..self.cells.len() {
            if self.may_be_bled(index) {
                self.cells[index].difference.forget_leak();
            }
        }
        let populations = self.populations();
        let mut foreign: Vec<Option<CellFault>> = Vec::with_capacity(self.cells.len());
        for index in 0..self.cells.len() {
            if !self.cells[index].is_compared {
                foreign.push(None);
                continue;
            }
            let judged = self.judged(index, &populations);
            // If the cell has a channel fault, only the first channel fault counts, because nothing else is known about
            // the cell.
            let fault =
                judged.iter().find(|it| it.kind.is_of_channel() && it.probability >= REPORTED).map(|it| it.kind);
            for it in judged {
                let probability = if fault.is_some_and(|fault| fault != it.kind) { 0.0 } else { it.probability };
                let finding = self.take(time, index, &Judgement { probability, ..it });
                if it.kind == CellFaultKind::ForeignCell {
                    let certain = Some(finding).filter(|it| it.probability >= REPORTED);
                    foreign.push(self.module_of(index).copied().or(certain));
                }
            }
        }
        self.find_modules(time, &foreign);
    }

    /// Size of each fault, per cell and kind, relative to the median of the pack and in the unit of the kind. `None`
    /// if the size cannot be judged. Possible reasons: the cell is not compared, its SOC is too far from the other
    /// cells' SOC, its channel is faulty, or the size is still too uncertain.
    pub fn sizes<const N: usize>(&self, kinds: [CellFaultKind; N]) -> Vec<[Option<ScalarGaussian>; N]> {
        let populations = self.populations();
        (0..self.cells.len()).map(|cell| kinds.map(|kind| self.size(cell, kind, &populations))).collect()
    }

    fn size(&self, index: usize, kind: CellFaultKind, populations: &[Population; STATES]) -> Option<ScalarGaussian> {
        let cell = CellIndex(index as u16);
        self.cells.get(index).filter(|cell| cell.is_compared)?;
        let judged = self.judged(index, populations).into_iter().find(|it| it.kind == kind)?;
        let is_found = || self.findings.iter().any(|found| found.kind == kind && found.is_of(cell));
        let since = self.cells[index].suspected[kind as usize - 1];
        let is_settled = since.zip(self.last_row).is_none_or(|(since, (now, ..))| self.has_lasted(kind, since, now));
        let is_known = judged.size.std() <= KNOWN_LIMITS * kind.limit() && is_settled || is_found();
        let is_judged = judged.is_comparable && is_known && self.has_channel_fault(cell) == Some(false);
        // Keeps an uncertain size below the limit, so that no alarm precedes the finding.
        let ScalarGaussian { mean, .. } = judged.size;
        let certainty = normal_cdf((mean.abs() - kind.limit()) / judged.size.std().max(1e-12));
        let is_certain = !self.is_prior && certainty >= REPORTED;
        let most = if is_certain || is_found() { f64::INFINITY } else { BELOW_LIMIT * kind.limit() };
        is_judged.then(|| ScalarGaussian { mean: mean.clamp(-most, most), ..judged.size })
    }

    /// Whether a cell's voltage reading is wrong or belongs to another cell. `None` if the cell is not compared or if
    /// no row has ended yet.
    pub fn has_channel_fault(&self, cell: CellIndex) -> Option<bool> {
        self.cells.get(cell.index()).filter(|cell| cell.is_compared)?;
        let is_found = self.findings.iter().any(|found| found.kind.is_channel_fault() && found.is_of(cell));
        if is_found { Some(true) } else { self.last_row.map(|_| false) }
    }

    fn populations(&self) -> [Population; STATES] {
        std::array::from_fn(|state| self.population(state))
    }

    /// Returns the cell with the clearly lowest voltage reading at the SOC at which a BMS bleeds cells. A BMS never
    /// bleeds this cell, because it balances by the readings, even if they are wrong. The cell stays the lowest until
    /// another cell reads lower.
    fn clearly_lowest(&self, slope_v: f64) -> Option<usize> {
        let (mut lowest, mut next): (Option<(usize, ScalarGaussian)>, Option<ScalarGaussian>) = (None, None);
        let compared = self.cells.iter().enumerate().filter(|(_, cell)| cell.is_compared);
        for (index, shown) in compared.map(|(index, cell)| (index, cell.difference.reading_v(slope_v))) {
            if lowest.is_none_or(|(_, least)| shown.mean < least.mean) {
                next = lowest.replace((index, shown)).map(|(_, shown)| shown);
            } else if next.is_none_or(|next| shown.mean < next.mean) {
                next = Some(shown);
            }
        }
        let ((lowest, shown), next) = lowest.zip(next)?;
        if self.lowest == Some(lowest) {
            return self.lowest;
        }
        (next.mean - shown.mean > 2.0 * shown.std().hypot(next.std())).then_some(lowest)
    }

    /// Whether a BMS may bleed the cell without sending a bit that shows it. True for a cell of a balanced pack if the
    /// cell has no such bit, is not the lowest cell and has no reported leak. A leaking cell has less charge than the
    /// other cells, so the BMS bleeds the other cells.
    pub(super) fn may_be_bled(&self, index: usize) -> bool {
        let is_found = |found: &CellFault| found.kind == CellFaultKind::Leak && found.is_of(CellIndex(index as u16));
        let is_open = self.is_balanced && !self.cells[index].bleed.timer.has_bits;
        is_open && self.lowest != Some(index) && !self.findings.iter().any(is_found)
    }

    fn judged(&self, index: usize, populations: &[Population; STATES]) -> [Judgement; 10] {
        let cell = &self.cells[index];
        let beyond = |state: usize, limit: f64, sign: f64| {
            let own = cell.difference.state(state);
            let population = &populations[state];
            let size = ScalarGaussian { mean: own.mean - population.middle, variance: own.variance };
            let probability = normal_cdf((sign * size.mean - limit) / size.std().max(1e-12));
            let stands_out = sign * size.mean >= OUTLIER * population.std;
            (size, if stands_out { probability } else { 0.0 })
        };
        let of = |kind: CellFaultKind, (size, probability): (ScalarGaussian, f64)| Judgement {
            kind,
            size,
            probability,
            is_comparable: true,
        };
        let sure = |kind: CellFaultKind, is_so: bool| {
            let so = if is_so { 1.0 } else { 0.0 };
            of(kind, (ScalarGaussian { mean: so, variance: 0.0 }, so))
        };
        let channel = [1.0, -1.0].map(|sign| beyond(CHANNEL, fault::CHANNEL_V, sign));
        let channel = if channel[0].1 >= channel[1].1 { channel[0] } else { channel[1] };
        let mut leak = beyond(LEAK, fault::LEAK_PER_DAY, 1.0);
        if self.may_be_bled(index) {
            // Bleeding looks like a leak, so the leak cannot be judged now. A real leak soon makes this cell the lowest
            // cell, which can be judged. Until then, the leak does no harm.
            leak = (ScalarGaussian { mean: 0.0, variance: 0.0 }, 0.0);
        } else if !cell.bleed.timer.has_bits && cell.difference.mean()[SOC] >= populations[SOC].middle {
            // A cell with more charge than the others may be losing it because the BMS bleeds it.
            leak = (ScalarGaussian { mean: leak.0.mean.min(0.0), ..leak.0 }, 0.0);
        }
        // A likely leak already explains a deviating voltage. Then report neither an offset of the voltage channel
        // nor a foreign cell.
        let unless_leaking =
            |(size, probability): (ScalarGaussian, f64)| (size, if leak.1 >= WITHDRAWN { 0.0 } else { probability });
        let (weak, foreign) =
            (beyond(CAPACITY, fault::CAPACITY, -1.0), unless_leaking(beyond(CAPACITY, fault::CAPACITY, 1.0)));
        let is_comparable = cell.difference.mean()[SOC].abs() < TOO_FAR;
        let if_near = |kind: CellFaultKind, (size, probability): (ScalarGaussian, f64)| Judgement {
            is_comparable,
            ..of(kind, (size, if is_comparable { probability } else { 0.0 }))
        };
        // If the model was derived from a label, its open-circuit curve may have half or twice the true slope. This
        // error looks like a difference in capacity, resistance or channel offset. A sudden change of the channel
        // does not depend on the curve.
        let if_known =
            |(size, probability): (ScalarGaussian, f64)| (size, if self.is_prior { 0.0 } else { probability });
        let (weak, foreign) = (if_known(weak), if_known(foreign));
        let (is_off, before_jump_v) = (channel.1 >= WITHDRAWN, cell.before_jump[CHANNEL]);
        let has_jumped = cell.jumped.is_some() && (channel.0.mean - before_jump_v).abs() >= fault::CHANNEL_V;
        let channel = if has_jumped { channel } else { if_known(channel) };
        // Another fault of the cell can explain its charge difference. If the charge difference is already a finding,
        // only another finding explains it.
        let is_listed = |kind: CellFaultKind| {
            self.findings.iter().any(|found| found.kind == kind && found.is_of(CellIndex(index as u16)))
        };
        let is_explained = if [CellFaultKind::LowCharge, CellFaultKind::HighCharge].into_iter().any(is_listed) {
            let others = [CellFaultKind::Leak, CellFaultKind::WeakCell, CellFaultKind::ForeignCell];
            others.into_iter().any(is_listed) || self.module_of(index).is_some()
        } else {
            is_off || leak.1 >= LIKELY || weak.1 >= WITHDRAWN || foreign.1 >= WITHDRAWN
        };
        let charge_beyond = |sign: f64| {
            let (size, probability) = self.constant_charge(index, populations, sign);
            (size, if is_explained { 0.0 } else { probability })
        };
        [
            sure(CellFaultKind::VoltageFrozen, cell.channel.is_frozen),
            sure(CellFaultKind::DoubledChannels, cell.channel.doubled().is_some()),
            if_near(CellFaultKind::VoltageChannel, unless_leaking(channel)),
            of(CellFaultKind::Leak, leak),
            if_near(CellFaultKind::Contact, beyond(CONTACT, fault::CONTACT, 1.0)),
            if_near(CellFaultKind::HighResistance, if_known(beyond(RESISTANCE, fault::RESISTANCE, 1.0))),
            of(CellFaultKind::WeakCell, weak),
            if_near(CellFaultKind::ForeignCell, foreign),
            of(CellFaultKind::LowCharge, charge_beyond(-1.0)),
            of(CellFaultKind::HighCharge, charge_beyond(1.0)),
        ]
    }

    /// Difference in charge, and the probability that it is beyond the limit. `sign`: 1 for more charge than the
    /// other cells, -1 for less. The probability is 0 while the cell's capacity is unknown. It is also 0 if the
    /// difference is within the limit when the pack is nearly full or nearly empty, because then the cell's capacity
    /// differs.
    pub(super) fn constant_charge(
        &self,
        index: usize,
        populations: &[Population; STATES],
        sign: f64,
    ) -> (ScalarGaussian, f64) {
        let soc = self.last_row.map_or(0.5, |(_, soc, _)| soc);
        let at = |soc_change: f64| {
            let own = self.cells[index].difference.soc_after(soc_change);
            let middle = populations[SOC].middle - soc_change * populations[CAPACITY].middle;
            ScalarGaussian { mean: own.mean - middle, ..own }
        };
        let size = at(0.0);
        let is_known = self.cells[index].difference.state(CAPACITY).std() <= KNOWN_CAPACITY_STD;
        let is_constant = is_known && CHARGE_AT.iter().all(|end| sign * at(end - soc).mean >= fault::CHARGE);
        let stands_out = sign * size.mean >= OUTLIER * populations[SOC].std;
        // The voltage must show the charge difference. If a charge difference and a channel offset cancel each other,
        // both are unknown.
        let middle_v = self.slope_v * populations[SOC].middle + populations[CHANNEL].middle;
        let shown_v = self.cells[index].difference.reading_v(self.slope_v).mean - middle_v;
        let is_constant = is_constant && sign * shown_v >= fault::CHARGE * self.slope_v;
        let probability = normal_cdf((sign * size.mean - fault::CHARGE) / size.std().max(1e-12));
        (size, if is_constant && stands_out { probability } else { 0.0 })
    }

    /// Updates the list of findings with a judgement. Also returns the judgement as a finding, even if it is not
    /// listed.
    fn take(&mut self, time: Timestamp, index: usize, judged: &Judgement) -> CellFault {
        let Judgement { kind, size, probability, .. } = *judged;
        let cell = &mut self.cells[index];
        let suspected = &mut cell.suspected[kind as usize - 1];
        if probability < WITHDRAWN {
            *suspected = None;
        } else if suspected.is_none() {
            let lasts = matches!(kind, CellFaultKind::Leak | CellFaultKind::LowCharge | CellFaultKind::HighCharge);
            let is_after_jump = |jumped: &Timestamp| !lasts && time.since(*jumped) < DAY_S;
            *suspected = Some(cell.jumped.filter(is_after_jump).unwrap_or(time));
        }
        let since = suspected.unwrap_or(time);
        let other = if kind == CellFaultKind::DoubledChannels { cell.channel.doubled() } else { None };
        let own = CellIndex(index as u16);
        let cells = other.map_or((own, own), |other| (own.min(CellIndex(other)), own.max(CellIndex(other))));
        let finding = CellFault { kind, cells: Some(cells), since, reported: time, probability, size };
        let is_in_module = kind == CellFaultKind::ForeignCell && self.module_of(index).is_some();
        // Two doubled channels share one finding. It is listed under the channel with the lower index.
        if cells.0 == own && !is_in_module {
            self.put(finding);
        }
        finding
    }

    /// Whether a fault of this kind has been likely for long enough to be reported. A charge difference must be
    /// constant for a day, because it may be the beginning of a leak. In a balanced pack, a leak must also last for a
    /// day, because other changes look like a leak until the cell has completed a cycle. A higher capacity must last
    /// for [`SAME_MODULE_S`], because the cell may belong to a replaced module whose other cells are found later.
    fn has_lasted(&self, kind: CellFaultKind, since: Timestamp, now: Timestamp) -> bool {
        let settling_s = match kind {
            CellFaultKind::Leak if self.is_balanced => DAY_S,
            CellFaultKind::LowCharge | CellFaultKind::HighCharge => DAY_S,
            CellFaultKind::ForeignCell => SAME_MODULE_S,
            _ => 0.0,
        };
        now.since(since) >= settling_s
    }

    /// Updates the list with a finding. A new finding is listed if its probability is at least [`REPORTED`] and it
    /// has lasted long enough. It replaces a listed finding of the same kind and first cell. If its probability is
    /// too low, the listed finding is removed.
    pub(super) fn put(&mut self, finding: CellFault) {
        let first = |found: &CellFault| found.cells.map(|cells| cells.0);
        let is_same = |found: &CellFault| found.kind == finding.kind && first(found) == first(&finding);
        let has_lasted = self.has_lasted(finding.kind, finding.since, finding.reported);
        match self.findings.iter().position(is_same) {
            Some(at) => {
                let CellFault { since, reported, .. } = self.findings.remove(at);
                if finding.probability >= finding.kind.withdrawn_below() {
                    let since = if finding.cells.is_some() { finding.since } else { since };
                    self.insert(CellFault { since, reported, ..finding });
                }
            }
            None if has_lasted && finding.probability >= REPORTED => self.insert(finding),
            None => {}
        }
    }

    pub(super) fn insert(&mut self, finding: CellFault) {
        let at = self.findings.partition_point(|found| (found.cells, found.kind) < (finding.cells, finding.kind));
        self.findings.insert(at, finding);
    }

    fn module_of(&self, index: usize) -> Option<&CellFault> {
        let is_of = |found: &&CellFault| found.kind == CellFaultKind::Module && found.is_of(CellIndex(index as u16));
        self.findings.iter().find(is_of)
    }

    /// Joins neighbouring cells into a replaced module if they have had more capacity than the other cells since
    /// about the same time. `foreign` has an entry per cell: the module finding that includes the cell or, if there is
    /// none, the cell's finding of a higher capacity with a probability of at least [`REPORTED`].
    fn find_modules(&mut self, time: Timestamp, foreign: &[Option<CellFault>]) {
        let is_same_event = |a: &Option<CellFault>, b: &Option<CellFault>| {
            a.zip(*b).is_some_and(|(a, b)| a.since.since(b.since).abs() <= SAME_MODULE_S)
        };
        let mut first = 0;
        for group in foreign.chunk_by(is_same_event) {
            let cells = (CellIndex(first as u16), CellIndex((first + group.len() - 1) as u16));
            first += group.len();
            if group.len() >= 2 && 2 * group.len() <= foreign.len() {
                self.put_module(time, cells, group);
            }
        }
    }

    fn put_module(&mut self, time: Timestamp, cells: (CellIndex, CellIndex), group: &[Option<CellFault>]) {
        let found = || group.iter().flatten();
        let (count, kind) = (group.len() as f64, CellFaultKind::Module);
        let size = ScalarGaussian {
            mean: found().map(|it| it.size.mean).sum::<f64>() / count,
            variance: found().map(|it| it.size.variance).sum::<f64>() / (count * count),
        };
        let since = found().map(|it| it.since).min().unwrap_or(time);
        let earlier = found().find(|it| it.kind == kind && it.cells == Some(cells));
        let reported = earlier.map_or(time, |it| it.reported);
        let is_within = |it: &CellFault| {
            matches!(it.kind, CellFaultKind::ForeignCell | CellFaultKind::Module)
                && it.cells.is_some_and(|(a, b)| cells.0 <= b && a <= cells.1)
        };
        self.findings.retain(|it| !is_within(it));
        self.insert(CellFault { kind, cells: Some(cells), since, reported, probability: 1.0, size });
        if earlier.is_none() {
            // The cells next to the module may also belong to it, even though they changed less. Raise their
            // uncertainty.
            let edges = [cells.0.index().checked_sub(1), Some(cells.1.index() + 1)];
            for edge in edges.into_iter().flatten() {
                self.cells.get_mut(edge).into_iter().for_each(|cell| cell.difference.widen_as(Jump::Replaced));
            }
        }
    }
}
