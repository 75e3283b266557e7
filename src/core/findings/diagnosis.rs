//! All cells of a pack: rows in, findings out.

use serde::{Deserialize, Serialize};

use super::channels::{Channel, compare};
use super::difference::{self, CHANNEL, CONTACT, Difference, Jump, LEAK, Observation, RESISTANCE, SOC, STATES};
use super::finding::{self, Finding, FindingKind, OUTLIER, REPORTED, WITHDRAWN};
use super::row::{CellSums, PackSums};
use super::temperature::Following;
use crate::cell::CellModel;
use crate::filter::ScalarGaussian;
use crate::quantity::{CellIndex, InvalidState, Timestamp};

/// A row ends when this part of the charge has moved, or after this time, s; at rest after this part of the rest, because it says
/// the same again.
const ROW_SOC: f64 = 0.02;
const ROW_S: f64 = 300.0;
const REST_PART: f64 = 0.5;
/// Longest time between two samples of a row, s.
const HOLE_S: f64 = 60.0;
/// Current of rest, part of the capacity per hour.
const REST_PER_H: f64 = 0.02;
/// Fewest cells with a middle.
const LEAST_CELLS: usize = 3;
/// Errors of a row: of the voltage, V; of the drop, fraction; of the SOC on the curve.
const ROW_V: f64 = 0.002;
const ROW_DROP: f64 = 0.03;
const ROW_CURVE: f64 = 0.001;
/// What a cell with another SOC adds, per unit of SOC: error of the curve, V, and of the drop, fraction. And the most that its
/// resistance may be that of the middle cells.
const FAR_V: f64 = 0.05;
const FAR_DROP: f64 = 1.0;
const MOST_ELSEWHERE: f64 = 3.0;
/// Difference of SOC beyond which a cell is too far from the others for a comparison of resistance and channel.
const TOO_FAR: f64 = 0.1;
/// Error of a resistance by steps, fraction, and of a step's voltage, V.
const STEP_PART: f64 = 0.05;
const STEP_V: f64 = 0.003;
/// Least sum of squared steps for a resistance, squares of the capacity per hour.
const LEAST_STEPS: f64 = 0.02;
/// Most that the mean cell's SOC may differ from what the charge says between two rows.
const SOC_JUMP: f64 = 0.02;
/// Rows of which the jumps of several cells are one event.
const SAME_EVENT_S: f64 = 1800.0;
/// The same of the cells of a module with more capacity than the others.
const SAME_MODULE_S: f64 = 3.0 * DAY_S;
/// Deviation within which exchanged channels explain each other, V.
const SWAP_V: f64 = 0.008;
const DAY_S: f64 = 86_400.0;
/// Deviation up to which a size is known, in limits of its kind.
const KNOWN_LIMITS: f64 = 2.0;

/// The cell in the middle of the pack, as the estimators know it at one moment.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeanCell {
    /// SOC, fraction.
    pub soc: f64,
    /// Current, A, positive = discharge.
    pub current_a: f64,
    /// Voltage drop of the series resistance and the branches, V.
    pub drop_v: f64,
    /// Temperature, degrees C.
    pub temperature_c: f64,
    /// Charge taken out so far, Ah: only differences mean anything.
    pub charge_ah: f64,
}

/// One cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Watched {
    difference: Difference,
    /// Its means before rows began to contradict them.
    settled: [f64; STATES],
    /// The same when it last changed at once.
    before_jump: [f64; STATES],
    sums: CellSums,
    channel: Channel,
    temperature: Following,
    /// Since when each kind is likelier than not.
    suspected: [Option<Timestamp>; FindingKind::ALL.len()],
    /// When it last changed at once.
    jumped: Option<Timestamp>,
}

/// The diagnosis of a pack.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Diagnosis {
    cells: Vec<Watched>,
    pack: PackSums,
    /// Middle, SOC and charge (Ah) of the last row.
    last_row: Option<(Timestamp, f64, f64)>,
    /// Time of rest so far, s.
    rest_s: f64,
    /// Series resistance of the mean cell in this row, ohm.
    ohm: f64,
    /// The cell with the middle SOC.
    middle: usize,
    /// The cell with the least charge, in a pack that a BMS balances.
    lowest: Option<usize>,
    findings: Vec<Finding>,
}

impl Diagnosis {
    /// For cells of which nothing is known.
    pub fn new(cells: usize) -> Self {
        let cell = Watched {
            difference: Difference::new(),
            settled: [0.0; STATES],
            before_jump: [0.0; STATES],
            sums: CellSums::default(),
            channel: Channel::default(),
            temperature: Following::default(),
            suspected: [None; FindingKind::ALL.len()],
            jumped: None,
        };
        Self {
            cells: vec![cell; if cells < LEAST_CELLS { 0 } else { cells }],
            pack: PackSums::default(),
            last_row: None,
            rest_s: 0.0,
            ohm: 0.0,
            middle: 0,
            lowest: None,
            findings: Vec::new(),
        }
    }

    /// Whether the pack has enough cells for a comparison.
    #[inline]
    pub fn is_active(&self) -> bool {
        !self.cells.is_empty()
    }

    /// What is found, in the order of the cells.
    pub fn findings(&self) -> &[Finding] {
        &self.findings
    }

    /// What is known of a cell's difference; `None` = the pack is not compared.
    pub fn difference(&self, cell: CellIndex) -> Option<&Difference> {
        self.cells.get(cell.index()).map(|cell| &cell.difference)
    }

    /// A cell's states less those of the middle of the pack; `None` = the pack is not compared, or has no such cell.
    pub fn relative(&self, cell: CellIndex) -> Option<[ScalarGaussian; STATES]> {
        let own = &self.cells.get(cell.index())?.difference;
        Some(std::array::from_fn(|state| {
            let middle = self.population(state).middle;
            let ScalarGaussian { mean, variance } = own.state(state);
            ScalarGaussian { mean: mean - middle, variance }
        }))
    }

    fn population(&self, state: usize) -> Population {
        Population::of(self.cells.iter().map(|cell| cell.difference.state(state).mean))
    }

    /// The cell whose estimate stands for the mean cell in the present row.
    #[inline]
    pub fn middle(&self) -> usize {
        self.middle
    }

    /// Takes a sample of a cell; `None` = no current is known, and the row ends.
    #[inline]
    pub fn add(
        &mut self,
        cell: usize,
        time: Timestamp,
        voltage_v: f64,
        current_a: Option<f64>,
        temperature_c: Option<f64>,
    ) {
        match (self.cells.get_mut(cell), current_a) {
            (Some(cell), Some(current_a)) => cell.sums.add(time, voltage_v, current_a, temperature_c, self.ohm),
            (Some(cell), None) => cell.sums.interrupt(),
            (None, _) => {}
        }
    }

    /// Takes the mean cell after the samples of a moment; whether the row is complete: [`Self::close_row`] then ends it.
    pub fn note(&mut self, time: Timestamp, mean: &MeanCell, capacity_ah: f64) -> bool {
        if ![mean.soc, mean.current_a, mean.drop_v, mean.temperature_c, mean.charge_ah].iter().all(|it| it.is_finite())
        {
            self.interrupt();
            return false;
        }
        let pack = &mut self.pack;
        if pack.last.is_some_and(|last| time.since(last) > HOLE_S) {
            *pack = PackSums::default();
            self.rest_s = 0.0;
            self.cells.iter_mut().for_each(|cell| cell.sums.interrupt());
        }
        let seconds = pack.last.replace(time).map_or(0.0, |last| time.since(last).max(0.0));
        let begun = *pack.begun.get_or_insert(time);
        let first_ah = if pack.count == 0 { mean.charge_ah } else { pack.first_ah };
        pack.first_ah = first_ah;
        pack.count += 1;
        pack.current_a += mean.current_a;
        pack.drop_v += mean.drop_v;
        pack.soc += mean.soc;
        pack.temperature_c += mean.temperature_c;
        pack.charge_ah += mean.charge_ah - first_ah;
        self.rest_s = if mean.current_a.abs() < REST_PER_H * capacity_ah { self.rest_s + seconds } else { 0.0 };
        (mean.charge_ah - first_ah).abs() >= ROW_SOC * capacity_ah
            || time.since(begun) >= ROW_S.max(REST_PART * self.rest_s)
    }

    /// Ends a row. `socs`: the cells' SOC as estimated, for the choice of the middle cell. `sensors`: how probable a fault is of the
    /// sensors that all cells share, by those who know. `is_balanced`: fuller cells may be bled after a charge. Returns the findings that are new.
    pub fn close_row(
        &mut self,
        model: &CellModel,
        capacity_ah: f64,
        socs: impl Fn(usize) -> Option<f64>,
        sensors: &[(FindingKind, f64, ScalarGaussian)],
        is_balanced: bool,
    ) -> Vec<Finding> {
        let pack = std::mem::take(&mut self.pack);
        let (Some(begun), Some(time)) = (pack.begun, pack.last) else { return Vec::new() };
        self.pack.last = pack.last;
        let mean = |sum: f64| sum / f64::from(pack.count.max(1));
        let (soc, charge_ah) = (mean(pack.soc), pack.first_ah + mean(pack.charge_ah));
        let row = Row {
            model,
            capacity_ah,
            soc,
            temperature_c: mean(pack.temperature_c),
            current_a: mean(pack.current_a),
            drop_v: mean(pack.drop_v),
            charge_ah,
        };
        let middle_time = begun.plus_secs(0.5 * time.since(begun));
        let seconds = self.last_row.map_or(0.0, |(last, ..)| middle_time.since(last));
        self.pass(middle_time, &row);
        let before = self.findings.clone();
        if self.observe(time, &row) {
            self.observe_temperatures(time, seconds);
            self.judge(time, is_balanced);
        }
        for &(kind, probability, size) in sensors {
            self.put(Finding { kind, cells: None, since: time, reported: time, probability, size });
        }
        self.findings.sort_by_key(|found| (found.cells, found.kind));
        self.cells.iter_mut().for_each(|cell| cell.sums.begin());
        self.ohm = model.r0_ohm(&model.grid_position(soc, row.temperature_c));
        self.choose_middle(socs);
        let is_new = |found: &&Finding| !before.iter().any(|old| (old.kind, old.cells) == (found.kind, found.cells));
        self.findings.iter().filter(is_new).copied().collect()
    }

    /// Lets time and charge since the last row pass.
    fn pass(&mut self, time: Timestamp, row: &Row<'_>) {
        let Some((last, last_soc, last_ah)) = self.last_row.replace((time, row.soc, row.charge_ah)) else { return };
        let counted = (last_ah - row.charge_ah) / row.capacity_ah;
        let estimated = row.soc - last_soc;
        // A filter that finds its SOC moves no charge.
        let change = if (estimated - counted).abs() < SOC_JUMP { estimated } else { counted };
        let days = (time.since(last) / DAY_S).max(0.0);
        self.cells.iter_mut().for_each(|cell| cell.difference.pass(days, change));
    }

    /// Compares every cell with the middle ones; whether there was something to compare.
    fn observe(&mut self, time: Timestamp, row: &Row<'_>) -> bool {
        let voltages_v: Vec<Option<f64>> = self.cells.iter().map(|cell| cell.sums.mean_v()).collect();
        let Some(middle_v) = middle(voltages_v.iter().flatten().copied()) else { return false };
        for cell in &mut self.cells {
            cell.channel.end_row(&cell.sums, middle_v);
        }
        let (mut channels, sums): (Vec<Channel>, Vec<CellSums>) =
            self.cells.iter().map(|cell| (cell.channel, cell.sums)).unzip();
        compare(&mut channels, &sums);
        self.cells.iter_mut().zip(channels).for_each(|(cell, channel)| cell.channel = channel);
        let mut jumped: Vec<(usize, Observation)> = Vec::new();
        for (index, voltage_v) in voltages_v.iter().enumerate() {
            let Some(voltage_v) = voltage_v else { continue };
            let cell = &mut self.cells[index];
            let observed = row.observation(cell.difference.mean(), voltage_v - middle_v);
            if cell.difference.is_settled() {
                cell.settled = *cell.difference.mean();
            }
            if cell.difference.observe(&observed) {
                (cell.jumped, cell.before_jump) = (Some(time), cell.settled);
                jumped.push((index, observed));
            }
        }
        self.handle_jumps(time, row, &jumped, |cell| voltages_v[cell].map(|v| v - middle_v));
        self.observe_steps(row);
        true
    }

    /// Cells have changed at once: two have been exchanged, some side by side replaced, or each by itself.
    fn handle_jumps(
        &mut self,
        time: Timestamp,
        row: &Row<'_>,
        jumped: &[(usize, Observation)],
        difference_v: impl Fn(usize) -> Option<f64>,
    ) {
        if jumped.is_empty() {
            return;
        }
        let is_recent = |cell: &Watched| cell.jumped.is_some_and(|at| time.since(at) <= SAME_EVENT_S);
        let recent: Vec<usize> = (0..self.cells.len()).filter(|&cell| is_recent(&self.cells[cell])).collect();
        if let [a, b] = recent[..]
            && let (Some(a_v), Some(b_v)) = (difference_v(a), difference_v(b))
            && self.exchange_if_swapped(time, row, [a, b], [a_v, b_v])
        {
            return;
        }
        for (index, observed) in jumped {
            let has_neighbour = recent.iter().any(|other| other.abs_diff(*index) == 1);
            let jump = if has_neighbour && 2 * recent.len() <= self.cells.len() { Jump::Replaced } else { Jump::Alone };
            self.cells[*index].difference.open(jump, observed);
        }
    }

    /// Compares the series resistances that the steps of the current show.
    fn observe_steps(&mut self, row: &Row<'_>) {
        let least_a2 = LEAST_STEPS * row.capacity_ah * row.capacity_ah;
        let ohms: Vec<Option<(f64, f64)>> = self.cells.iter().map(|cell| cell.sums.ohm(least_a2)).collect();
        let Some(middle_ohm) = middle(ohms.iter().flatten().map(|(ohm, _)| *ohm)) else { return };
        let (now_ohm, contact_ohm) = (row.ohm(), row.contact_ohm());
        let mut slope = [0.0; STATES];
        (slope[RESISTANCE], slope[CONTACT]) = (now_ohm, contact_ohm);
        for (cell, ohm) in self.cells.iter_mut().zip(ohms) {
            let Some((ohm, steps_a2)) = ohm else { continue };
            let mean = cell.difference.mean();
            let expected = slope[RESISTANCE] * mean[RESISTANCE] + slope[CONTACT] * mean[CONTACT];
            let (part, noise) = (STEP_PART * now_ohm, STEP_V / steps_a2.sqrt());
            let observed =
                Observation { innovation: ohm - middle_ohm - expected, slope, variance: part * part + noise * noise };
            cell.difference.observe_steps(&observed);
        }
    }

    /// Exchanges what is known of two cells whose voltages have become each other's; whether they are.
    fn exchange_if_swapped(
        &mut self,
        time: Timestamp,
        row: &Row<'_>,
        [a, b]: [usize; 2],
        differences_v: [f64; 2],
    ) -> bool {
        let [of_a, of_b] = [self.cells[a].before_jump, self.cells[b].before_jump];
        let off = |means: &[f64; STATES], difference_v: f64| row.observation(means, difference_v).innovation.abs();
        let as_before = off(&of_a, differences_v[0]).min(off(&of_b, differences_v[1]));
        let exchanged = off(&of_b, differences_v[0]).max(off(&of_a, differences_v[1]));
        if exchanged > SWAP_V || exchanged > 0.5 * as_before {
            return false;
        }
        let (low, high) = self.cells.split_at_mut(b);
        std::mem::swap(&mut low[a].difference, &mut high[0].difference);
        low[a].difference.settle(&of_b);
        high[0].difference.settle(&of_a);
        let cells = Some((CellIndex(a as u16), CellIndex(b as u16)));
        let is_same = |found: &Finding| found.kind == FindingKind::SwappedChannels && found.cells == cells;
        if self.findings.iter().any(is_same) {
            self.findings.retain(|found| !is_same(found));
        } else {
            let size = ScalarGaussian { mean: 1.0, variance: 0.0 };
            let kind = FindingKind::SwappedChannels;
            self.findings.push(Finding { kind, cells, since: time, reported: time, probability: 1.0, size });
        }
        for cell in [a, b] {
            self.cells[cell].jumped = None;
        }
        true
    }

    fn choose_middle(&mut self, socs: impl Fn(usize) -> Option<f64>) {
        let mut order: Vec<(f64, usize)> = (0..self.cells.len()).filter_map(|cell| Some((socs(cell)?, cell))).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        if let Some((_, cell)) = order.get(order.len() / 2) {
            self.middle = *cell;
        }
    }

    /// Judges all cells.
    fn judge(&mut self, time: Timestamp, is_balanced: bool) {
        let populations = self.populations();
        let charges = self.cells.iter().map(|cell| cell.difference.mean()[SOC]);
        let lowest = charges.enumerate().min_by(|a, b| a.1.total_cmp(&b.1)).map(|(cell, _)| cell);
        self.lowest = lowest.filter(|_| is_balanced);
        for index in 0..self.cells.len() {
            let judged = self.judged(index, &populations);
            let has_channel_fault = judged.iter().any(|it| it.kind.is_of_channel() && it.probability >= REPORTED);
            for it in judged {
                let probability = if has_channel_fault && !it.kind.is_of_channel() { 0.0 } else { it.probability };
                self.take(time, index, &Judged { probability, ..it });
            }
        }
        self.find_modules(time);
    }

    /// Per cell, what a kind is of, against the middle of the pack, in the unit of the kind; `None` = it cannot be judged: the cell is
    /// too far from the others, its channel is faulty, or the value is not known well enough yet.
    pub fn sizes(&self, kind: FindingKind) -> Vec<Option<ScalarGaussian>> {
        let populations = self.populations();
        (0..self.cells.len()).map(|cell| self.size(cell, kind, &populations)).collect()
    }

    fn size(&self, index: usize, kind: FindingKind, populations: &[Population; STATES]) -> Option<ScalarGaussian> {
        let cell = CellIndex(index as u16);
        let judged = self.judged(index, populations).into_iter().find(|it| it.kind == kind)?;
        let is_found = || self.findings.iter().any(|found| found.kind == kind && found.is_of(cell));
        let is_known = judged.size.std() <= KNOWN_LIMITS * kind.limit() || is_found();
        (judged.is_comparable && is_known && self.has_channel_fault(cell) == Some(false)).then_some(judged.size)
    }

    /// Whether what is read as a cell's voltage is not that; `None` = not compared yet.
    pub fn has_channel_fault(&self, cell: CellIndex) -> Option<bool> {
        let is_found = self.findings.iter().any(|found| found.kind.is_channel_fault() && found.is_of(cell));
        if is_found { Some(true) } else { self.last_row.map(|_| false) }
    }

    fn populations(&self) -> [Population; STATES] {
        std::array::from_fn(|state| self.population(state))
    }

    /// Whether a loss of charge is the cell's own. A cell that is bled until it is like the others loses charge as well, but it is
    /// above them; where a BMS balances, all but the lowest one are. A leak that was found is still there when the others are bled.
    fn can_leak(&self, index: usize, populations: &[Population; STATES]) -> bool {
        let is_found = |found: &Finding| found.kind == FindingKind::Leak && found.is_of(CellIndex(index as u16));
        let is_below = self.cells[index].difference.mean()[SOC] < populations[SOC].middle;
        let is_lowest = self.lowest.is_none_or(|lowest| lowest == index);
        is_below && (is_lowest || self.findings.iter().any(is_found))
    }

    /// What one cell may have.
    fn judged(&self, index: usize, populations: &[Population; STATES]) -> Vec<Judged> {
        let cell = &self.cells[index];
        let beyond = |state: usize, limit: f64, sign: f64, is_outlier: bool| {
            let own = cell.difference.state(state);
            let population = &populations[state];
            let size = ScalarGaussian { mean: own.mean - population.middle, variance: own.variance };
            let probability = normal_cdf((sign * size.mean - limit) / size.std().max(1e-12));
            let stands_out = !is_outlier || sign * size.mean >= OUTLIER * population.std;
            (size, if stands_out { probability } else { 0.0 })
        };
        let of = |kind: FindingKind, (size, probability): (ScalarGaussian, f64)| Judged {
            kind,
            size,
            probability,
            is_comparable: true,
        };
        let sure = |kind: FindingKind, is_so: bool| {
            let so = if is_so { 1.0 } else { 0.0 };
            of(kind, (ScalarGaussian { mean: so, variance: 0.0 }, so))
        };
        let channel = [1.0, -1.0].map(|sign| beyond(CHANNEL, finding::CHANNEL_V, sign, true));
        let channel = if channel[0].1 >= channel[1].1 { channel[0] } else { channel[1] };
        let mut leak = beyond(LEAK, finding::LEAK_PER_DAY, 1.0, true);
        if !self.can_leak(index, populations) {
            leak.0.mean = leak.0.mean.min(0.0);
            leak.1 = 0.0;
        }
        let is_comparable = cell.difference.mean()[SOC].abs() < TOO_FAR;
        let if_near = |kind: FindingKind, (size, probability): (ScalarGaussian, f64)| Judged {
            is_comparable,
            ..of(kind, (size, if is_comparable { probability } else { 0.0 }))
        };
        vec![
            sure(FindingKind::VoltageFrozen, cell.channel.is_frozen),
            sure(FindingKind::DoubledChannels, cell.channel.doubled().is_some()),
            if_near(FindingKind::VoltageChannel, channel),
            of(FindingKind::Leak, leak),
            if_near(FindingKind::Contact, beyond(CONTACT, finding::CONTACT, 1.0, true)),
            if_near(FindingKind::HighResistance, beyond(RESISTANCE, finding::RESISTANCE, 1.0, true)),
            of(FindingKind::WeakCell, beyond(difference::CAPACITY, finding::CAPACITY, -1.0, true)),
            if_near(FindingKind::ForeignCell, beyond(difference::CAPACITY, finding::CAPACITY, 1.0, true)),
        ]
    }

    /// Takes a judgement into the list.
    fn take(&mut self, time: Timestamp, index: usize, judged: &Judged) {
        let Judged { kind, size, probability, .. } = *judged;
        let cell = &mut self.cells[index];
        let suspected = &mut cell.suspected[kind as usize - 1];
        if probability < WITHDRAWN {
            *suspected = None;
        } else if suspected.is_none() {
            let is_after_jump = |jumped: &Timestamp| time.since(*jumped) < DAY_S;
            *suspected = Some(cell.jumped.filter(is_after_jump).unwrap_or(time));
        }
        let other = if kind == FindingKind::DoubledChannels { cell.channel.doubled() } else { None };
        let own = CellIndex(index as u16);
        let cells = other.map_or((own, own), |other| (own.min(CellIndex(other)), own.max(CellIndex(other))));
        let since = suspected.unwrap_or(time);
        let is_in_module = kind == FindingKind::ForeignCell && self.is_in_module(index);
        // The upper one of two doubled channels is in the finding of the lower one.
        if cells.0 == own && !is_in_module {
            self.put(Finding { kind, cells: Some(cells), since, reported: time, probability, size });
        }
    }

    fn is_in_module(&self, index: usize) -> bool {
        let holds = |(first, last): (CellIndex, CellIndex)| (first.index()..=last.index()).contains(&index);
        self.findings.iter().any(|found| found.kind == FindingKind::Module && found.cells.is_some_and(holds))
    }

    /// Puts a finding into the list, in place of an earlier one of its kind and first cell, or takes that out.
    fn put(&mut self, finding: Finding) {
        let first = |found: &Finding| found.cells.map(|cells| cells.0);
        let is_same = |found: &Finding| found.kind == finding.kind && first(found) == first(&finding);
        match self.findings.iter().position(is_same) {
            Some(at) if finding.probability < finding.kind.withdrawn_below() => drop(self.findings.remove(at)),
            Some(at) => {
                let Finding { since, reported, .. } = self.findings[at];
                let since = if finding.cells.is_some() { finding.since } else { since };
                self.findings[at] = Finding { since, reported, ..finding };
            }
            None if finding.probability >= REPORTED => self.findings.push(finding),
            None => {}
        }
    }

    /// Compares the temperatures at the cells with that in the middle of the pack.
    fn observe_temperatures(&mut self, time: Timestamp, seconds: f64) {
        let of_cells: Vec<Option<f64>> = self.cells.iter().map(|cell| cell.sums.mean_c()).collect();
        if of_cells.iter().flatten().count() < LEAST_CELLS {
            return;
        }
        let middle_c = Population::of(of_cells.iter().flatten().copied()).middle;
        for (cell, here_c) in self.cells.iter_mut().zip(of_cells) {
            if let Some(here_c) = here_c {
                cell.temperature.observe(seconds, middle_c, here_c);
            }
        }
        let kind = FindingKind::TemperatureSensor;
        let reported: Vec<Finding> = self.findings.iter().filter(|found| found.kind == kind).copied().collect();
        self.findings.retain(|found| found.kind != kind);
        let mut first = 0;
        for of_one in self.cells.chunk_by(|a, b| a.temperature == b.temperature) {
            if of_one[0].temperature.is_detached {
                let cells = Some((CellIndex(first as u16), CellIndex((first + of_one.len() - 1) as u16)));
                let before = reported.iter().find(|found| found.cells == cells);
                let since = before.map_or(time, |found| found.since);
                let reported = before.map_or(time, |found| found.reported);
                let size = ScalarGaussian { mean: 1.0, variance: 0.0 };
                self.findings.push(Finding { kind, cells, since, reported, probability: 1.0, size });
            }
            first += of_one.len();
        }
    }

    /// Joins cells side by side with more capacity than the others, found at about the same time, to a replaced module.
    fn find_modules(&mut self, time: Timestamp) {
        let kind = FindingKind::ForeignCell;
        let of_cell = |found: &Finding| {
            found.cells.filter(|(first, last)| found.kind == kind && first == last).map(|(first, _)| first.index())
        };
        let mut since: Vec<Option<(Timestamp, ScalarGaussian)>> = vec![None; self.cells.len()];
        for found in &self.findings {
            if let Some(cell) = of_cell(found) {
                since[cell] = Some((found.since, found.size));
            }
        }
        let in_module = |at: usize| {
            let holds = |(first, last): (CellIndex, CellIndex)| (first.index()..=last.index()).contains(&at);
            let module = |found: &&Finding| found.kind == FindingKind::Module && found.cells.is_some_and(holds);
            self.findings.iter().find(module).map(|found| (found.since, found.size))
        };
        let known: Vec<Option<(Timestamp, ScalarGaussian)>> =
            since.iter().enumerate().map(|(at, since)| since.or_else(|| in_module(at))).collect();
        let mut first = 0;
        while first < known.len() {
            let Some((begun, _)) = known[first] else {
                first += 1;
                continue;
            };
            let same = |other: &&Option<(Timestamp, ScalarGaussian)>| {
                other.is_some_and(|(it, _)| it.since(begun).abs() <= SAME_MODULE_S)
            };
            let group: Vec<ScalarGaussian> =
                known[first..].iter().take_while(same).filter_map(|it| it.map(|(_, size)| size)).collect();
            let count = group.len();
            let cells = Some((CellIndex(first as u16), CellIndex((first + count - 1) as u16)));
            if count >= 2 && 2 * count <= known.len() {
                let within =
                    |found: &Finding| of_cell(found).is_some_and(|cell| (first..first + count).contains(&cell));
                let overlaps = |found: &Finding| {
                    found.kind == FindingKind::Module
                        && found.cells.is_some_and(|(a, b)| a.index() < first + count && first <= b.index())
                };
                let earlier = self.findings.iter().find(|found| overlaps(found)).copied();
                let reported = earlier.filter(|it| it.cells == cells).map_or(time, |it| it.reported);
                let n = count as f64;
                let size = ScalarGaussian {
                    mean: group.iter().map(|size| size.mean).sum::<f64>() / n,
                    variance: group.iter().map(|size| size.variance).sum::<f64>() / (n * n),
                };
                self.findings.retain(|found| !within(found) && !overlaps(found));
                let kind = FindingKind::Module;
                self.findings.push(Finding { kind, cells, since: begun, reported, probability: 1.0, size });
            }
            first += count.max(1);
        }
    }

    /// The charge of the cells is not known any more: a time of unknown length has passed.
    pub fn forget_charge(&mut self) {
        self.interrupt();
        self.last_row = None;
        self.cells.iter_mut().for_each(|cell| cell.difference.forget_charge());
    }

    /// What follows does not hang together with the samples so far.
    pub fn interrupt(&mut self) {
        self.pack = PackSums::default();
        self.rest_s = 0.0;
        self.cells.iter_mut().for_each(|cell| cell.sums.interrupt());
    }

    /// Moves every stamp by `by_nanos`, onto another clock.
    pub fn rebase(&mut self, by_nanos: i64) {
        let moved = |stamp: &mut Timestamp| *stamp = stamp.plus_nanos(by_nanos);
        self.findings.iter_mut().for_each(|found| {
            moved(&mut found.since);
            moved(&mut found.reported);
        });
        self.last_row.iter_mut().for_each(|(time, ..)| moved(time));
        for cell in &mut self.cells {
            cell.suspected.iter_mut().flatten().chain(&mut cell.jumped).for_each(moved);
        }
    }

    /// Checks the numbers of a stored diagnosis of this many cells.
    ///
    /// # Errors
    /// The first impossible number.
    pub fn check(&self, cells: usize) -> Result<(), InvalidState> {
        let expected = if cells < LEAST_CELLS { 0 } else { cells };
        let count = self.cells.len();
        InvalidState::unless(count == expected, "the cells of the diagnosis", count as f64, "those of the pack")?;
        let middle = self.middle;
        InvalidState::unless(middle <= cells, "the middle cell of the diagnosis", middle as f64, "a cell of the pack")?;
        for cell in &self.cells {
            cell.difference.check()?;
            let numbers = cell
                .sums
                .numbers()
                .into_iter()
                .chain(cell.channel.numbers())
                .chain(cell.temperature.numbers())
                .chain(cell.settled)
                .chain(cell.before_jump);
            InvalidState::unless_numbers("a number of the diagnosis", numbers)?;
        }
        let PackSums { current_a, drop_v, soc, temperature_c, charge_ah, first_ah, .. } = self.pack;
        let last = self.last_row.map_or([0.0; 2], |(_, soc, charge_ah)| [soc, charge_ah]);
        let numbers = [current_a, drop_v, soc, temperature_c, charge_ah, first_ah, self.rest_s, self.ohm];
        InvalidState::unless_numbers("a number of the diagnosis", numbers.into_iter().chain(last))?;
        for found in &self.findings {
            let (first, last) = found.cells.unwrap_or((CellIndex(0), CellIndex(0)));
            let is_there = first <= last && last.index() < cells;
            InvalidState::unless(is_there, "the cell of a finding", f64::from(last.0), "a cell of the pack")?;
            InvalidState::unless_numbers("a finding", [found.size.mean, found.size.variance, found.probability])?;
        }
        Ok(())
    }
}

/// A judgement of one kind.
#[derive(Debug, Clone, Copy)]
struct Judged {
    kind: FindingKind,
    size: ScalarGaussian,
    probability: f64,
    /// Whether the cell is near enough to the others for it.
    is_comparable: bool,
}

/// What all cells of a row share.
struct Row<'a> {
    model: &'a CellModel,
    capacity_ah: f64,
    soc: f64,
    temperature_c: f64,
    current_a: f64,
    drop_v: f64,
    charge_ah: f64,
}

impl Row<'_> {
    /// Observation of a cell's difference, V, by the means of its states.
    fn observation(&self, means: &[f64; STATES], difference_v: f64) -> Observation {
        let (model, temperature) = (self.model, self.model.temperature_position(self.temperature_c));
        let at = |soc: f64| model.grid_position_at(&temperature, soc.clamp(0.0, 1.0));
        let (own, middle) = (at(self.soc + means[SOC]), at(self.soc));
        let slope_v = model.ocv_slope_v(&own, self.capacity_ah).max(0.0);
        let contact_v = self.current_a * self.contact_ohm();
        let slope = [slope_v, 0.0, -self.drop_v, -contact_v, 1.0, 0.0];
        let curve_v = model.aged_ocv_v(&own, self.capacity_ah) - model.aged_ocv_v(&middle, self.capacity_ah);
        // Elsewhere on the curve a healthy cell has another resistance.
        let elsewhere = (model.r0_ohm(&own) / model.r0_ohm(&middle)).clamp(1.0 / MOST_ELSEWHERE, MOST_ELSEWHERE) - 1.0;
        let expected_v = curve_v - self.drop_v * elsewhere
            + slope[RESISTANCE] * means[RESISTANCE]
            + slope[CONTACT] * means[CONTACT]
            + means[CHANNEL];
        let far = means[SOC].abs();
        let (drop_v, on_curve_v) = ((ROW_DROP + far * FAR_DROP) * self.drop_v, ROW_CURVE * slope_v);
        let far_v = far * FAR_V;
        let variance = ROW_V * ROW_V + far_v * far_v + drop_v * drop_v + on_curve_v * on_curve_v;
        Observation { innovation: difference_v - expected_v, slope, variance }
    }

    /// Series resistance of the mean cell now, ohm.
    fn ohm(&self) -> f64 {
        self.model.r0_ohm(&self.model.grid_position(self.soc, self.temperature_c))
    }

    /// The same in the middle of the charge at 25 degrees C: the unit of a contact, which follows neither.
    fn contact_ohm(&self) -> f64 {
        self.model.r0_ohm(&self.model.grid_position(0.5, 25.0))
    }
}

/// Probability that a standard normal value is below.
fn normal_cdf(value: f64) -> f64 {
    0.5 * libm::erfc(-value / std::f64::consts::SQRT_2)
}

/// Middle and robust standard deviation (median of the absolute deviations) of the cells.
struct Population {
    middle: f64,
    std: f64,
}

impl Population {
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let median = |sorted: &[f64]| {
            if sorted.is_empty() { 0.0 } else { 0.5 * (sorted[(sorted.len() - 1) / 2] + sorted[sorted.len() / 2]) }
        };
        let middle = median(&values);
        let mut off: Vec<f64> = values.iter().map(|value| (value - middle).abs()).collect();
        off.sort_by(f64::total_cmp);
        Self { middle, std: 1.4826 * median(&off) }
    }
}

/// Mean of the middle half of some values: one cell that is off hardly moves it. `None` = fewer than three.
fn middle(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    if values.len() < LEAST_CELLS {
        return None;
    }
    values.sort_by(f64::total_cmp);
    let cut = values.len() / 4;
    let inner = &values[cut..values.len() - cut];
    Some(inner.iter().sum::<f64>() / inner.len() as f64)
}
