//! Decides which signal carries which quantity. Names and units
//! ([`SignalLabel`](crate::wiring::evidence::SignalLabel)), ranges and behaviour give points, each with a reason in
//! words.
//!
//! The points are weights of evidence that were chosen on three cars. A value outside the range of a quantity excludes
//! it. A unit or a name gives 1 to 3 points. Behaviour that hardly any other signal shows gives up to 4 points. For
//! example, a pack voltage falls when the current rises, and equals the sum of the cells.

use super::groups::{SignalGroup, groups};
use super::label::PackLabel;
use super::log_signal::{LogSignal, SignalOrigin};
use super::raw;
use super::{Candidate, PositiveDirection};
use crate::can::unit::Quantity;
use crate::filter::ends;
use crate::quantity::BusIndex;
use crate::wiring::evidence::{PackQuantity, Score, Series, Slope};

#[derive(Debug, Clone)]
pub(super) struct Evidence {
    pub(super) members: Vec<usize>,
    name: String,
    bus: BusIndex,
    score: Score,
    low: f64,
    high: f64,
    positive: Option<PositiveDirection>,
    is_sum: bool,
}

impl Evidence {
    /// Returns `None` if the label excludes the quantity, or if a value lies outside the inclusive `range`.
    fn new(index: usize, signal: &LogSignal, quantity: PackQuantity, range: (f64, f64)) -> Option<Self> {
        let (low, high) = (signal.series.extent.min, signal.series.extent.max);
        let mut score = signal.label.score(quantity).filter(|_| low >= range.0 && high <= range.1)?;
        // The search selected an unnamed field by its values, so its label gives no points.
        if signal.is_unnamed() {
            score = Score::default();
        }
        // Temperatures, SOC and SOH of a pack hardly change within minutes.
        let points = match quantity {
            PackQuantity::Temperature | PackQuantity::Soh => 0.0,
            PackQuantity::Soc => -0.5,
            PackQuantity::Current | PackQuantity::PackVoltage | PackQuantity::CellVoltage => -1.5,
        };
        let is_constant = signal.series.is_constant() && (!signal.is_unnamed() || points == 0.0);
        score.add(points, is_constant, "never changes in this log");
        let (members, name, bus) = (vec![index], signal.name.clone(), signal.bus);
        Some(Self { members, name, bus, score, low, high, positive: None, is_sum: false })
    }

    fn add(&mut self, points: f64, holds: bool, reason: &str) {
        self.score.add(points, holds, reason);
    }

    /// Whether the values vary by at most 35 %, like the voltage of a pack in use.
    fn is_steady(&self) -> bool {
        self.high - self.low <= 0.35 * self.high
    }

    fn has_both_signs(&self) -> bool {
        self.low < 0.0 && self.high > 0.0
    }
}

pub(super) fn candidates(signals: &[LogSignal], interfaces: &[String], label: &PackLabel) -> Vec<Candidate> {
    let groups = groups(&signals.iter().map(|signal| (partition(signal), signal.name.as_str())).collect::<Vec<_>>());
    let usable: Vec<usize> = (0..signals.len()).filter(|index| signals[*index].is_mostly_valid()).collect();
    let mut voltages: Vec<Evidence> =
        usable.iter().filter_map(|index| voltage(*index, &signals[*index], label)).collect();
    let mut currents: Vec<Evidence> = usable.iter().filter_map(|index| current(*index, &signals[*index])).collect();
    sort(&mut voltages);
    sort(&mut currents);
    let mut cells: Vec<Evidence> = groups.iter().filter_map(|group| cell_group(group, signals)).collect();
    let grouped: std::collections::BTreeSet<usize> = cells.iter().flat_map(|group| group.members.clone()).collect();
    let alone = usable.iter().filter(|index| !grouped.contains(index));
    cells.extend(alone.filter_map(|index| single_cell(*index, &signals[*index], label)));
    compare_sums(&mut voltages, &mut cells, signals);
    sort(&mut cells);
    compare_currents(&mut voltages, &mut cells, &mut currents, signals);
    let mut temperatures: Vec<Evidence> = groups.iter().filter_map(|group| temperature_group(group, signals)).collect();
    temperatures.extend(usable.iter().filter_map(|index| temperature(*index, &signals[*index])));
    let percents = |judge: fn(usize, &LogSignal) -> Option<Evidence>| {
        usable.iter().filter_map(|index| judge(*index, &signals[*index])).collect::<Vec<_>>()
    };
    currents.iter_mut().for_each(|current| state_direction(current, signals));
    let mut socs = percents(soc);
    compare_socs(&mut socs, signals);
    let all = [
        (PackQuantity::Current, currents),
        (PackQuantity::PackVoltage, voltages),
        (PackQuantity::CellVoltage, cells),
        (PackQuantity::Temperature, temperatures),
        (PackQuantity::Soc, socs),
        (PackQuantity::Soh, percents(soh)),
    ];
    all.into_iter().flat_map(|(quantity, evidence)| ranked(quantity, evidence, interfaces)).collect()
}

/// Returns the partition (interface and source) of a signal. Only signals of one partition form groups. A field that no
/// definition describes has a name with the numbers of its answer (service and identifier). These numbers must not
/// count as the numbers of group members, so each answer is a partition of its own. Cell voltages in such fields are
/// numbered across all answers of a controller, so the controller is their partition.
fn partition(signal: &LogSignal) -> String {
    let source = match &signal.origin {
        SignalOrigin::Dbc(_) => String::new(),
        SignalOrigin::Defined(_) => "defined".to_owned(),
        SignalOrigin::Raw(key, field) if !field.name.starts_with(raw::CELL) => format!("{key:?}"),
        SignalOrigin::Raw(key, _) => key.response.to_string(),
        SignalOrigin::Field(_) => "field".to_owned(),
    };
    format!("{} {source}", signal.bus.index())
}

fn sort(evidence: &mut [Evidence]) {
    evidence.sort_by(|a, b| {
        b.score.points.total_cmp(&a.score.points).then_with(|| (a.bus, &a.name).cmp(&(b.bus, &b.name)))
    });
}

fn ranked(quantity: PackQuantity, mut evidence: Vec<Evidence>, interfaces: &[String]) -> Vec<Candidate> {
    sort(&mut evidence);
    let mut known = std::collections::BTreeSet::new();
    evidence.retain(|evidence| known.insert((evidence.bus, evidence.name.clone())));
    let good = evidence.into_iter().filter(|evidence| evidence.score.points >= 2.5).take(10);
    let candidate = |(rank, evidence): (usize, Evidence)| Candidate {
        quantity,
        rank: rank + 1,
        interface: interfaces.get(evidence.bus.index()).cloned().unwrap_or_default(),
        signal: evidence.name,
        signals: evidence.members.len(),
        low: evidence.low,
        high: evidence.high,
        points: evidence.score.points,
        positive: evidence.positive,
        reasons: evidence.score.reasons,
        members: evidence.members,
    };
    good.enumerate().map(candidate).collect()
}

fn voltage(index: usize, signal: &LogSignal, label: &PackLabel) -> Option<Evidence> {
    let range = label.pack_v();
    let mut evidence = Evidence::new(index, signal, PackQuantity::PackVoltage, range.unwrap_or((15.0, 1000.0)))?;
    if signal.is_unnamed() {
        return Some(raw_voltage(evidence, signal, range));
    }
    evidence.add(1.0, evidence.is_steady(), "range of a pack in use");
    evidence.add(-1.0, evidence.high < 60.0 && range.is_none(), "");
    Some(evidence)
}

fn raw_voltage(mut evidence: Evidence, signal: &LogSignal, range: Option<(f64, f64)>) -> Evidence {
    let (series, low, high) = (&signal.series, evidence.low, evidence.high);
    match range {
        Some(_) => evidence.add(2.0, true, "voltage of the pack on the label"),
        None => evidence.add(2.0, (250.0..=850.0).contains(&series.extent.mean()), "typical voltage of a pack"),
    }
    evidence.add(1.5, high - low <= 0.05 * high && high > low, "changes slightly");
    evidence.add(1.5, 2 * series.distinct() >= series.values.kept().len().min(100), "its last digits vary");
    evidence.add(-1.5, high == low, "never changes in this log");
    let step = signal.field().map_or(0.0, |field| field.factor);
    evidence.add(-1.0, step > 0.2, "coarse steps");
    evidence
}

fn raw_current(mut evidence: Evidence, signal: &LogSignal) -> Evidence {
    let Some(field) = signal.field() else {
        // The search selected a field of a message because it changes with a voltage.
        evidence.add(1.0, true, "its scale is a guess");
        // A field of 12 bits may be part of a longer field.
        let is_long = matches!(&signal.origin, SignalOrigin::Field(own) if own.signal.layout.length_bits > 12);
        evidence.add(0.5, is_long, "");
        evidence.add(1.0, evidence.has_both_signs(), "has both signs");
        return evidence;
    };
    // If a signed field of 24 or 32 bits fits into 16 bits, the upper bits only repeat the sign. This hardly occurs by
    // chance.
    let needed = 32_768.0 * field.factor;
    let is_extended = field.length > 16 && evidence.low >= -needed && evidence.high <= needed && evidence.low < 0.0;
    // The 32-bit field gets more points than the shorter fields that it contains.
    let points = if field.length == 32 { 3.0 } else { 2.0 };
    evidence.add(points, is_extended, &format!("a signed number of {} bits", field.length));
    evidence.add(-1.0, evidence.high - evidence.low < 1.0, "hardly moves");
    evidence.add(1.0, evidence.has_both_signs(), "has both signs");
    evidence.add(1.0, evidence.high - evidence.low <= 600.0, "");
    evidence
}

impl LogSignal {
    fn is_mostly_valid(&self) -> bool {
        let (good, bad) = (self.series.count() as f64, self.series.invalid() as f64);
        good >= 0.8 * (good + bad)
    }

    fn is_unnamed(&self) -> bool {
        matches!(self.origin, SignalOrigin::Raw(..) | SignalOrigin::Field(_))
    }

    fn shares_bits(&self, other: &Self) -> bool {
        if let (SignalOrigin::Field(own), SignalOrigin::Field(others)) = (&self.origin, &other.origin) {
            return own.id == others.id && own.signal.layout.overlaps(&others.signal.layout);
        }
        let (SignalOrigin::Raw(own, _), SignalOrigin::Raw(others, _)) = (&self.origin, &other.origin) else {
            return false;
        };
        let spans = self.span().zip(other.span());
        own == others && spans.is_some_and(|(a, b)| a.0 <= b.1 && b.0 <= a.1)
    }

    fn field(&self) -> Option<&crate::import::DiagnosticSignal> {
        match &self.origin {
            SignalOrigin::Raw(_, field) => Some(field),
            SignalOrigin::Dbc(_) | SignalOrigin::Defined(_) | SignalOrigin::Field(_) => None,
        }
    }
}

fn current(index: usize, signal: &LogSignal) -> Option<Evidence> {
    let mut evidence = Evidence::new(index, signal, PackQuantity::Current, (-2000.0, 2000.0))?;
    if signal.is_unnamed() {
        return Some(raw_current(evidence, signal));
    }
    evidence.add(1.0, evidence.has_both_signs(), "has both signs");
    evidence.add(0.0, signal.is_read_signed, "its definition says unsigned, but its values are signed");
    evidence.add(-1.5, evidence.low == 0.0 && evidence.high == 0.0, "is always 0");
    Some(evidence)
}

/// Plausible voltages of a cell in a group (V), including a failing cell.
const CELL_V: (f64, f64) = (1.5, 4.5);

fn single_cell(index: usize, signal: &LogSignal, label: &PackLabel) -> Option<Evidence> {
    let mut evidence = Evidence::new(index, signal, PackQuantity::CellVoltage, label.cell_v())?;
    evidence.add(1.0, signal.label.says_extreme(), "an extreme of the cells, not a single cell");
    Some(evidence)
}

fn cell_group(group: &SignalGroup, signals: &[LogSignal]) -> Option<Evidence> {
    let is_cell = |index: &usize| {
        let LogSignal { label, series, .. } = &signals[*index];
        label.may_measure(Quantity::Voltage)
            && series.extent.min >= CELL_V.0
            && series.extent.max <= CELL_V.1
            && signals[*index].is_mostly_valid()
    };
    let members: Vec<usize> = group.members.iter().map(|(_, index)| *index).filter(is_cell).collect();
    if members.len() < 3 {
        return None;
    }
    let first = &signals[members[0]];
    let (low, high) = extent(members.iter().map(|index| &signals[*index].series));
    let (least, largest) = ends(members.iter().map(|index| signals[*index].series.extent.mean()));
    let spread = largest - least;
    let (together, is_moving) = moves_together(&members, signals);
    let manner = if is_moving { " that move together" } else { "" };
    let (count, left_out) = (members.len(), group.members.len() - members.len());
    let mut score = Score::default();
    score.add(2.0, true, &format!("{count} values of {low:.3} to {high:.3} V{manner}"));
    score.add(2.0, count >= 8, "");
    score.add(2.0, spread <= 0.3, "");
    score.add(-2.0, spread > 0.6, &format!("they differ by {spread:.2} V"));
    score.add(2.0 * together.max(0.0), is_moving, "");
    score.add(1.0, first.label.has_unit_of(Quantity::Voltage), "unit V");
    score.add(2.0, first.label.says_cell(), "the name says cell");
    score.add(1.0, first.label.is_of_pack(), "");
    score.add(0.0, left_out > 0, &format!("{left_out} more with this name have no plausible values"));
    let (name, bus) = (group.pattern.clone(), first.bus);
    Some(Evidence { members, name, bus, score, low, high, positive: None, is_sum: false })
}

/// Returns the mean correlation between the changes of the first member and the next eight, and whether it is at least
/// 0.3.
fn moves_together(members: &[usize], signals: &[LogSignal]) -> (f64, bool) {
    let first = &signals[members[0]].series;
    let others = members.iter().skip(1).take(8);
    let found: Vec<f64> =
        others.filter_map(|index| Some(Slope::between(&signals[*index].series, first)?.correlation())).collect();
    let mean = found.iter().sum::<f64>() / found.len().max(1) as f64;
    (mean, mean >= 0.3)
}

fn temperature_group(group: &SignalGroup, signals: &[LogSignal]) -> Option<Evidence> {
    let found: Vec<usize> = group
        .members
        .iter()
        .map(|member| member.1)
        .filter(|index| temperature(*index, &signals[*index]).is_some())
        .collect();
    let first = *found.first().filter(|_| found.len() >= 2)?;
    let mut evidence = temperature(first, &signals[first])?;
    evidence.name.clone_from(&group.pattern);
    (evidence.low, evidence.high) = extent(found.iter().map(|index| &signals[*index].series));
    let text = format!("{} sensors of {:.1} to {:.1} degC", found.len(), evidence.low, evidence.high);
    evidence.add(1.0, evidence.high - evidence.low <= 25.0, &text);
    evidence.add(1.0, group.pattern.contains("Row"), "");
    evidence.members = found;
    Some(evidence)
}

fn temperature(index: usize, signal: &LogSignal) -> Option<Evidence> {
    let mut evidence = Evidence::new(index, signal, PackQuantity::Temperature, (-40.0, 90.0))?;
    evidence.add(1.5, signal.is_unnamed(), "may be a temperature: its scale is a guess");
    evidence.add(1.0, signal.series.largest_step() <= 2.0, "changes slowly");
    evidence.add(-2.0, evidence.low <= -39.0 || (evidence.low == 0.0 && evidence.high == 0.0), "may mean \"no value\"");
    Some(evidence)
}

fn soc(index: usize, signal: &LogSignal) -> Option<Evidence> {
    let mut evidence = Evidence::new(index, signal, PackQuantity::Soc, (0.0, 105.0))?;
    evidence.add(1.0, signal.series.largest_step() <= 1.0, "changes slowly");
    evidence.add(-2.0, evidence.high == 0.0, "is always 0");
    Some(evidence)
}

fn soh(index: usize, signal: &LogSignal) -> Option<Evidence> {
    Evidence::new(index, signal, PackQuantity::Soh, (40.0, 110.0))
}

/// If the voltages do not show the sign of a current, the description decides.
fn state_direction(current: &mut Evidence, signals: &[LogSignal]) {
    let stated = signals[current.members[0]].stated;
    if let (None, Some(direction)) = (current.positive, stated) {
        current.positive = Some(direction);
        current.add(0.0, true, &format!("its comment says: positive is {}", direction.name()));
    }
}

/// Compares the states of charge with each other. Equal candidates confirm each other.
fn compare_socs(socs: &mut [Evidence], signals: &[LogSignal]) {
    const AGREEMENT: f64 = 3.0;
    /// Lower values (%) are not compared, because unused signals are zero.
    const EMPTY: f64 = 1.0;
    let means: Vec<f64> = socs.iter().map(|soc| signals[soc.members[0]].series.extent.mean()).collect();
    let agree = |mean: f64, other: f64| mean >= EMPTY && other >= EMPTY && (other - mean).abs() <= AGREEMENT;
    let others = |mean: f64| means.iter().filter(|other| agree(mean, **other)).count().saturating_sub(1);
    let agreeing: Vec<usize> = means.iter().map(|mean| others(*mean)).collect();
    let is_agreed = agreeing.iter().any(|count| *count > 0);
    for (soc, count) in socs.iter_mut().zip(agreeing) {
        soc.add(
            1.0,
            count > 0,
            &if count == 1 { "1 other agrees".to_owned() } else { format!("{count} others agree") },
        );
        soc.add(-1.0, count == 0 && is_agreed, "the others agree on another value");
    }
}

/// Compares every steady pack voltage with the sum of each group of at least four cells.
fn compare_sums(voltages: &mut [Evidence], cells: &mut [Evidence], signals: &[LogSignal]) {
    for group in cells.iter_mut().filter(|group| group.members.len() >= 4) {
        let sum: f64 = group.members.iter().map(|index| signals[*index].series.extent.mean()).sum();
        let mut is_found = false;
        for voltage in voltages.iter_mut().filter(|voltage| voltage.is_steady()) {
            let mean = signals[voltage.members[0]].series.extent.mean();
            if (mean / sum - 1.0).abs() <= 0.02 {
                voltage.is_sum = true;
                voltage.add(4.0, true, &format!("equals the sum of {}, {sum:.1} V", group.name));
                if !is_found {
                    group.add(3.0, true, &format!("their sum, {sum:.1} V, equals {}", voltage.name));
                }
                is_found = true;
            }
        }
    }
}

/// Finds for each current the voltage that responds best. The direction of the response gives the sign of the current.
/// If several currents select the same voltage, only the best-ranked current gives it points. The first cell represents
/// a group of cells.
fn compare_currents(
    voltages: &mut [Evidence],
    cells: &mut [Evidence],
    currents: &mut [Evidence],
    signals: &[LogSignal],
) {
    // A known voltage has a name, belongs to a group, or equals the sum of the cells. If there are known voltages, only
    // they are compared.
    let is_known =
        |voltage: &Evidence| voltage.is_sum || !signals[voltage.members[0]].is_unnamed() || voltage.members.len() > 1;
    let has_known = voltages.iter().chain(cells.iter()).any(is_known);
    for current in currents.iter_mut().take(40) {
        let related = |voltage: &Evidence| response(&signals[voltage.members[0]], &signals[current.members[0]]);
        let compared = voltages.iter_mut().take(40).chain(cells.iter_mut().take(5));
        // A voltage limit is a calculated value, so its response does not show the sign.
        let is_limit = |voltage: &Evidence| voltage.low > 60.0 && signals[voltage.members[0]].label.says_extreme();
        let compared = compared.filter(|voltage| !is_limit(voltage) && (!has_known || is_known(voltage)));
        let found = compared.filter_map(|voltage| Some((related(voltage)?, voltage)));
        let weight = |slope: Slope, voltage: &Evidence| slope.correlation().abs() + 0.05 * voltage.score.points;
        let best = found.max_by(|a, b| weight(a.0, a.1).total_cmp(&weight(b.0, b.1)));
        let Some((slope, voltage)) = best else { continue };
        let correlation = slope.correlation();
        let (direction, verb) = match slope.ohm > 0.0 {
            true => (PositiveDirection::Discharge, "falls"),
            false => (PositiveDirection::Charge, "rises"),
        };
        let text = format!(
            "{} {verb} by {:.4} V per A (correlation {correlation:.2}): positive is {}",
            voltage.name,
            slope.ohm.abs(),
            direction.name()
        );
        current.add(3.0 * correlation.abs(), true, &text);
        current.positive = Some(direction);
        let text = format!("{verb} when {} rises (correlation {correlation:.2})", current.name);
        if !voltage.score.reasons.iter().any(|reason| reason.contains("(correlation")) {
            voltage.add(3.0 * correlation.abs(), true, &text);
        }
    }
}

/// Returns the response of a voltage to a current, if the response is significant and plausible for a pack.
fn response(voltage: &LogSignal, current: &LogSignal) -> Option<Slope> {
    let shares_bits = voltage.shares_bits(current);
    let slope = Slope::between(&voltage.series, &current.series).filter(|_| !shares_bits)?;
    // The range corresponds to 4 milliohms to 4 ohms at 400 V.
    let is_plausible = (1e-5..=1e-2).contains(&(slope.ohm.abs() / voltage.series.extent.mean()));
    // There are many unnamed fields, so some agree by chance.
    let is_raw = voltage.is_unnamed() || current.is_unnamed();
    let correlation = slope.correlation().abs();
    let is_significant = slope.strength() >= if is_raw { 4.0 } else { 2.0 };
    (is_plausible && is_significant && correlation >= 0.5).then_some(slope)
}

fn extent<'a>(series: impl Iterator<Item = &'a Series>) -> (f64, f64) {
    ends(series.flat_map(|one| [one.extent.min, one.extent.max]))
}
