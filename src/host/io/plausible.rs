//! Judges whether readings are in their assumed units.
//!
//! In: times (s), currents (A) and voltages of a cell (V), which may be wrong by a factor. Out: an [`Implausible`] that
//! names what is wrong and the unit that the values probably have. The rules reject only readings that no cell can
//! cause; unusual readings pass. NaN means "no reading".

/// Maximum plausible current, as a multiple of the capacity per hour.
const MAX_C_RATE: f64 = 100.0;

/// Maximum plausible current if the capacity is unknown (A).
const MAX_CURRENT_A: f64 = 2000.0;

/// Maximum plausible voltage of a cell (V). A module of four cells passes, because some tables call it a cell.
const MAX_CELL_V: f64 = 20.0;

/// Minimum plausible median voltage of a cell (V).
const MIN_CELL_V: f64 = 0.5;

/// Plausible range of a cell's resistance times its capacity (ohm Ah). Usual cells have 0.02 to 0.5, so a current
/// that is wrong by a factor of 1000 is outside.
const RESISTANCE_CAPACITY: (f64, f64) = (0.000_5, 20.0);

/// Minimum number of current steps for a judgement on the resistance or the sign.
const MIN_STEPS: usize = 10;

/// If a larger share of the readings is beyond a limit, the table is in the wrong unit. A smaller share counts as
/// faults of single readings.
const MAX_SHARE: f64 = 0.01;

/// Maximum plausible charge that a cell gives or takes in one direction, as a multiple of its capacity.
const MAX_CAPACITIES: f64 = 3.0;

/// Maximum plausible change of the mean voltage, relative to the charge that has moved (V per full capacity). At the
/// ends of its curve, a cell reaches 30.
const MAX_SLOPE_V: f64 = 40.0;

/// Last plausible date: 2100-01-01 (s since 1970).
const LAST_DATE_S: f64 = 4_102_444_800.0;

/// Readings that cannot be in the stated unit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Implausible {
    /// `time`, `current` or `voltage`.
    pub quantity: &'static str,
    /// What was found and why it is impossible.
    pub what: String,
    /// Unit that the values probably have, such as `ms` or `mA`.
    pub probable: Option<&'static str>,
}

/// What is known of the pack.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PackSize {
    /// Capacity of the pack (Ah); `None` = unknown.
    pub capacity_ah: Option<f64>,
}

impl PackSize {
    /// Largest plausible current (A).
    pub fn max_current_a(&self) -> f64 {
        self.capacity_ah.map_or(MAX_CURRENT_A, |capacity_ah| MAX_C_RATE * capacity_ah)
    }
}

fn implausible(quantity: &'static str, probable: Option<&'static str>, what: String) -> Result<(), Implausible> {
    Err(Implausible { quantity, what, probable })
}

/// Unit of a time stamp that is after 2100 if it is read as seconds since 1970: `ms`, `us` or `ns`. `None` = the stamp
/// may be in seconds.
pub fn probable_stamp_unit(seconds: f64) -> Option<&'static str> {
    let units = [(1e3, "ms"), (1e6, "us"), (1e9, "ns")];
    let is_past = seconds.abs() > LAST_DATE_S;
    is_past.then(|| units.into_iter().find(|(factor, _)| seconds.abs() / factor <= LAST_DATE_S).map_or("ns", |of| of.1))
}

/// Returns the probable unit of times that cannot be in seconds. `step_s`: typical step between rows if the times are
/// read as seconds.
fn probable_step_unit(step_s: f64) -> &'static str {
    // Rows are usually at most 100 s apart.
    [(1e3, "ms"), (1e6, "us")].into_iter().find(|(factor, _)| step_s / factor <= 100.0).map_or("ns", |of| of.1)
}

/// Checks the times of rows (s).
///
/// # Errors
/// More than 1 % of the times are after 2100.
pub fn check_dates(time_s: &[f64]) -> Result<(), Implausible> {
    let Some(late) = beyond(time_s, LAST_DATE_S) else { return Ok(()) };
    let first = time_s.first().copied().and_then(probable_stamp_unit);
    let probable = first.unwrap_or_else(|| probable_step_unit(median_step(time_s).unwrap_or_default()));
    implausible("time", Some(probable), format!("{late} is after the year 2100 as seconds since 1970"))
}

/// Checks the order of the times of rows (s).
///
/// # Errors
/// More than a fifth of the times are before the previous row's time, or at least ten rows advance by less than 1 us
/// each.
pub fn check_order(time_s: &[f64]) -> Result<(), Implausible> {
    let known = || time_s.iter().copied().filter(|time_s| time_s.is_finite());
    let span_s = known().fold(f64::MIN, f64::max) - known().fold(f64::MAX, f64::min);
    if time_s.len() >= 10 && (0.0..1e-6 * time_s.len() as f64).contains(&span_s) {
        return implausible("time", None, "advances by less than 1 us per row".to_owned());
    }
    let back = time_s.windows(2).filter(|pair| pair[1] < pair[0]).count();
    if back * 5 <= time_s.len() {
        return Ok(());
    }
    implausible("time", None, format!("runs backwards in {back} of {} rows", time_s.len()))
}

/// Longest step that is not a gap: ten times the median step.
pub(super) fn longest_step(time_s: &[f64]) -> f64 {
    10.0 * median_step(time_s).unwrap_or_default()
}

pub(super) fn median_step(time_s: &[f64]) -> Option<f64> {
    median(&time_s.windows(2).map(|pair| pair[1] - pair[0]).collect::<Vec<_>>())
}

/// Checks currents (A) against the largest plausible current.
///
/// # Errors
/// More than 1 % of the currents are too large.
pub fn check_currents(current_a: &[f64], size: PackSize) -> Result<(), Implausible> {
    let limit_a = size.max_current_a();
    let Some(largest) = beyond(current_a, limit_a) else { return Ok(()) };
    let rate = size.capacity_ah.map_or_else(String::new, |capacity_ah| format!(" ({:.0} C)", largest / capacity_ah));
    implausible("current", Some("mA"), format!("{largest} A{rate} is impossible, at most {limit_a} A"))
}

/// Checks voltages of a cell (V).
pub fn check_voltages(cell_voltage_v: &[f64]) -> Result<(), Implausible> {
    if let Some(largest) = beyond(cell_voltage_v, MAX_CELL_V) {
        let probable = (1000.0..=1000.0 * MAX_CELL_V).contains(&largest).then_some("mV");
        return implausible("voltage", probable, format!("{largest} V per cell is impossible, at most {MAX_CELL_V} V"));
    }
    let Some(median) = median(cell_voltage_v) else { return Ok(()) };
    if median > 0.0 && median < MIN_CELL_V {
        let what = format!("half of the readings are below {median} V per cell");
        return implausible("voltage", None, what);
    }
    Ok(())
}

/// Checks a current by the response of the voltage to its steps, and by the charge that it moves.
///
/// # Errors
/// The current or the times are wrong by a factor.
pub fn check_response(
    time_s: &[f64],
    current_a: &[f64],
    cell_voltage_v: &[f64],
    size: PackSize,
) -> Result<(), Implausible> {
    let Some(capacity_ah) = size.capacity_ah else { return Ok(()) };
    let all: Vec<(f64, f64)> =
        steps(time_s, current_a, cell_voltage_v).into_iter().filter(|(_, voltage_v)| *voltage_v != 0.0).collect();
    let largest = all.iter().fold(0.0_f64, |max, (current_a, _)| max.max(current_a.abs()));
    let large: Vec<_> =
        all.iter().filter(|(current_a, _)| *current_a != 0.0 && current_a.abs() >= 0.1 * largest).collect();
    let falls = large.iter().filter(|(current_a, voltage_v)| current_a * voltage_v < 0.0).count();
    if large.len() >= MIN_STEPS && falls.max(large.len() - falls) * 10 >= large.len() * 9 {
        let sum = |term: fn(f64, f64) -> f64| large.iter().map(|&&(i, v)| term(i, v)).sum::<f64>();
        let resistance_ohm = sum(|i, v| i * v).abs() / sum(|i, _| i * i);
        let what = format!("the voltage changes by {resistance_ohm:.1e} V per A, impossible for {capacity_ah} Ah");
        if resistance_ohm * capacity_ah < RESISTANCE_CAPACITY.0 {
            return implausible("current", Some("mA"), what);
        }
        if resistance_ohm * capacity_ah > RESISTANCE_CAPACITY.1 {
            return implausible("current", Some("A"), what);
        }
    }
    check_charge(time_s, current_a, capacity_ah)
}

/// Checks that the charge stays within a few capacities. After a gap, the count restarts, because a charge may be
/// missing. Currents below a twentieth of the capacity per hour do not count, because the offset of a sensor adds up
/// over months.
///
/// # Errors
/// The current moves more than three capacities in one direction, without moving half a capacity back in between.
pub fn check_charge(time_s: &[f64], current_a: &[f64], capacity_ah: f64) -> Result<(), Implausible> {
    let longest_s = longest_step(time_s);
    let mut span_ah = 0.0_f64;
    for sign in [1.0, -1.0] {
        let (mut charge_ah, mut low_ah, mut high_ah) = (0.0_f64, 0.0_f64, 0.0_f64);
        for (pair, current_a) in time_s.windows(2).zip(current_a) {
            let step_s = pair[1] - pair[0];
            if current_a.abs() >= 0.05 * capacity_ah && (0.0..=longest_s).contains(&step_s) {
                charge_ah += sign * current_a * step_s / 3600.0;
            }
            high_ah = high_ah.max(charge_ah);
            if step_s > longest_s || charge_ah < low_ah || charge_ah < high_ah - 0.5 * capacity_ah {
                (low_ah, high_ah) = (charge_ah, charge_ah);
            }
            span_ah = span_ah.max(high_ah - low_ah);
        }
    }
    if span_ah <= MAX_CAPACITIES * capacity_ah {
        return Ok(());
    }
    let what = format!(
        "the current moves {span_ah:.0} Ah one way, but the rated capacity is {capacity_ah} Ah (it must include all \
         parallel cells)"
    );
    // If the steps are at least 20, the times are probably in ms or a smaller unit, because rows are rarely less than
    // 20 ms apart.
    let probable = median_step(time_s).filter(|step_s| *step_s >= 20.0).map(probable_step_unit);
    implausible("time", probable, what)
}

/// Compares the mean voltages of tenths of the rows, and checks that enough charge flows between two tenths to explain
/// the change. Only consecutive tenths with mean currents of the same sign are compared, because the voltage recovers
/// after a load even without a charge.
///
/// # Errors
/// The voltage changes by more than 40 V per capacity.
pub fn check_slope(
    time_s: &[f64],
    current_a: &[f64],
    cell_voltage_v: &[f64],
    capacity_ah: f64,
) -> Result<(), Implausible> {
    let rows = time_s.len().min(current_a.len()).min(cell_voltage_v.len());
    let part = (rows / 10).max(1);
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let parts: Vec<(f64, f64, f64)> = (0..rows / part)
        .map(|n| n * part..(n + 1) * part)
        .map(|of| (mean(&time_s[of.clone()]), mean(&current_a[of.clone()]), mean(&cell_voltage_v[of])))
        .collect();
    let largest = parts.iter().fold(0.0_f64, |max, part| max.max(part.1.abs()));
    for (n, first) in parts.iter().enumerate().filter(|_| rows >= 20) {
        let mut charge_ah = 0.0;
        for pair in
            parts[n..].windows(2).take_while(|pair| pair[1].1 * first.1 > 0.0 && pair[1].1.abs() > 0.7 * largest)
        {
            charge_ah += (pair[1].0 - pair[0].0) * (pair[0].1 + pair[1].1).abs() / 2.0 / 3600.0;
            let (change_v, capacities) = (pair[1].2 - first.2, charge_ah / capacity_ah);
            if first.1.abs() > 0.7 * largest && change_v.abs() > 0.2 && change_v.abs() > MAX_SLOPE_V * capacities {
                let what = format!(
                    "moves {:.2} % of the capacity while the voltage changes by {change_v:.2} V",
                    100.0 * capacities
                );
                let unit = if change_v.abs() > 60.0 * MAX_SLOPE_V * capacities { "h" } else { "min" };
                return implausible("time", Some(unit), what);
            }
        }
    }
    Ok(())
}

/// Direction of positive current that the voltage shows in its responses to current steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ShownSign {
    /// The voltage falls when the current rises.
    Discharge,
    /// The voltage rises when the current rises.
    Charge,
    /// The voltage often falls and often rises, and the current is never negative. The current is therefore a
    /// magnitude.
    Magnitude,
    /// Too few or contradictory responses.
    Unclear,
}

/// Finds the direction of positive current from the voltage's response to current steps. If there are few steps,
/// stretches of constant current also count if their voltage changes by at least 100 mV. Stretches of a varying load
/// do not count, because the voltage may recover although the cell discharges.
pub fn shown_sign(time_s: &[f64], current_a: &[f64], cell_voltage_v: &[f64]) -> ShownSign {
    let largest = current_a.iter().copied().filter(|i| i.is_finite()).fold(0.0_f64, |max, i| max.max(i.abs()));
    let is_never_negative = current_a.iter().all(|&i| i.is_nan() || i >= -0.01 * largest);
    let mut votes: Vec<bool> = steps(time_s, current_a, cell_voltage_v)
        .into_iter()
        .filter(|(i, v)| *i != 0.0 && i.abs() >= 0.1 * largest && v.abs() > 0.0005)
        .map(|(i, v)| i * v < 0.0)
        .collect();
    if votes.len() < MIN_STEPS {
        let plateaus = plateaus(current_a, cell_voltage_v, largest);
        votes.extend(plateaus.into_iter().flat_map(|is_discharge| [is_discharge; 5]));
    }
    let discharge = votes.iter().filter(|&&is_discharge| is_discharge).count();
    let charge = votes.len() - discharge;
    let (most, fewest) = (discharge.max(charge), discharge.min(charge));
    if is_never_negative && fewest >= 5 && fewest * 6 >= most {
        return ShownSign::Magnitude;
    }
    if most < 5 || fewest * 4 > most {
        return ShownSign::Unclear;
    }
    if discharge > charge { ShownSign::Discharge } else { ShownSign::Charge }
}

/// Changes of current and voltage between consecutive rows that have both. Changes across a gap are left out, because
/// the recorder may have missed a charge.
fn steps(time_s: &[f64], current_a: &[f64], voltage_v: &[f64]) -> Vec<(f64, f64)> {
    let rows = time_s
        .iter()
        .zip(current_a)
        .zip(voltage_v)
        .map(|((time_s, current_a), voltage_v)| [*time_s, *current_a, *voltage_v]);
    let rows: Vec<[f64; 3]> = rows.filter(|row| row.iter().all(|value| value.is_finite())).collect();
    let longest_s = longest_step(&rows.iter().map(|row| row[0]).collect::<Vec<_>>());
    let near = rows.windows(2).filter(|pair| (0.0..=longest_s).contains(&(pair[1][0] - pair[0][0])));
    near.map(|pair| (pair[1][1] - pair[0][1], pair[1][2] - pair[0][2])).collect()
}

/// For each stretch of constant current, whether a positive current means discharge. The voltage must change by at
/// least 100 mV.
fn plateaus(current_a: &[f64], voltage_v: &[f64], largest: f64) -> Vec<bool> {
    const MIN_ROWS: usize = 20;
    const SETTLING_ROWS: usize = 5;
    let mut votes = Vec::new();
    let mut start = 0;
    for end in 1..=current_a.len().min(voltage_v.len()) {
        let is_constant = current_a.get(end).is_some_and(|i| (i - current_a[start]).abs() <= 0.02 * largest);
        if is_constant && end < voltage_v.len() {
            continue;
        }
        // A small current after a large one is not evidence, because the voltage recovers.
        if end - start >= MIN_ROWS && current_a[start].abs() >= 0.15 * largest && largest > 0.0 {
            let stretch = &voltage_v[start + SETTLING_ROWS..end];
            let change_v = stretch[stretch.len() - 1] - stretch[0];
            let is_farthest_at_end = stretch.iter().all(|v| (v - stretch[0]).abs() <= change_v.abs() + 0.02);
            let is_vote = change_v.abs() >= 0.1 && is_farthest_at_end;
            votes.extend(is_vote.then_some(change_v * current_a[start] < 0.0));
        }
        start = end;
    }
    votes
}

/// The largest value, if more than 1 % of the values are beyond the limit.
fn beyond(values: &[f64], limit: f64) -> Option<f64> {
    let known = values.iter().filter(|value| value.is_finite()).count();
    let count = values.iter().filter(|value| value.abs() > limit).count();
    let largest = values.iter().filter(|value| value.is_finite()).fold(0.0_f64, |max, value| max.max(value.abs()));
    (count > 0 && count as f64 > MAX_SHARE * known as f64).then_some(largest)
}

pub(super) fn median(values: &[f64]) -> Option<f64> {
    let mut known: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
    let middle = known.len() / 2;
    (!known.is_empty()).then(|| *known.select_nth_unstable_by(middle, f64::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: PackSize = PackSize { capacity_ah: Some(3.0) };

    /// A drive: current (A, positive = discharge) and voltage (V) of a cell of 3 Ah and 30 mohm.
    fn drive() -> (Vec<f64>, Vec<f64>, Vec<f64>) {
        let current: Vec<f64> = (0..600).map(|n| 3.0 * (f64::from(n) * 0.7).sin() + 1.0).collect();
        let mut charge_ah = 0.0;
        let voltage = current.iter().map(|current_a| {
            charge_ah += current_a / 3600.0;
            3.9 - 0.3 * charge_ah - 0.03 * current_a
        });
        let voltage = voltage.collect();
        ((0..600).map(f64::from).collect(), current, voltage)
    }

    fn scaled(values: &[f64], factor: f64) -> Vec<f64> {
        values.iter().map(|value| value * factor).collect()
    }

    #[test]
    fn wrong_units_are_named_right_ones_pass() {
        let (time, current, voltage) = drive();
        let check = |time: &[f64], current: &[f64], voltage: &[f64]| {
            check_dates(time)?;
            check_order(time)?;
            check_voltages(voltage)?;
            check_currents(current, SIZE)?;
            check_response(time, current, voltage, SIZE)
        };
        let found = |result: Result<(), Implausible>| result.err().map(|of| (of.quantity, of.probable));
        assert_eq!(found(check(&time, &current, &voltage)), None);
        assert_eq!(found(check(&time, &scaled(&current, 1000.0), &voltage)), Some(("current", Some("mA"))));
        // Without the limit on the current, the response of the voltage alone shows the wrong unit.
        assert_eq!(
            found(check_response(&time, &scaled(&current, 1000.0), &voltage, SIZE)),
            Some(("current", Some("mA")))
        );
        assert_eq!(found(check(&time, &scaled(&current, 0.001), &voltage)), Some(("current", Some("A"))));
        assert_eq!(found(check(&time, &current, &scaled(&voltage, 1000.0))), Some(("voltage", Some("mV"))));
        assert_eq!(found(check(&time, &current, &scaled(&voltage, 0.001))), Some(("voltage", None)));
        assert_eq!(found(check(&scaled(&time, 1000.0), &current, &voltage)), Some(("time", Some("ms"))));
        let backwards: Vec<f64> = time.iter().rev().copied().collect();
        assert_eq!(found(check(&backwards, &current, &voltage)), Some(("time", None)));
        for (factor, unit) in [(1e3, "ms"), (1e6, "us"), (1e9, "ns")] {
            let stamps: Vec<f64> = time.iter().map(|time| (1.7e9 + time) * factor).collect();
            assert_eq!(found(check(&stamps, &current, &voltage)), Some(("time", Some(unit))));
        }
    }

    #[test]
    fn gaps_and_offsets_do_not_count_as_charge() {
        let check = |time_s: &[f64], current_a: &[f64]| check_charge(time_s, current_a, 3.0).is_ok();
        let minutes: Vec<f64> = (0..40_000).map(|n| 60.0 * f64::from(n)).collect();
        let cycles: Vec<f64> = (0..40_000).map(|n| if n / 100 % 2 == 0 { 1.5 } else { -1.47 }).collect();
        assert!(check(&minutes, &vec![0.1; 40_000]) && check(&minutes, &cycles));
        assert!(check(&[0.0, 60.0, 120.0, 360_000.0, 360_060.0], &[3.0; 5]) && !check(&minutes, &vec![1.0; 40_000]));
        // A discharge of one hour. The file states the time in minutes, but the time is read as seconds.
        let (time, current) = ((0..60).map(f64::from).collect::<Vec<_>>(), [3.0; 60]);
        let voltage: Vec<f64> = time.iter().map(|time| 4.1 - time / 60.0).collect();
        let slope =
            |factor: f64| check_slope(&scaled(&time, factor), &current, &voltage, 3.0).err().and_then(|of| of.probable);
        assert_eq!((slope(1.0), slope(60.0)), (Some("min"), None));
    }

    #[test]
    fn sign_and_magnitude_are_shown_by_steps() {
        let (time, current, voltage) = drive();
        assert_eq!(shown_sign(&time, &current, &voltage), ShownSign::Discharge);
        assert_eq!(shown_sign(&time, &scaled(&current, -1.0), &voltage), ShownSign::Charge);
        let magnitude: Vec<f64> = current.iter().map(|value| value.abs()).collect();
        assert_eq!(shown_sign(&time, &magnitude, &voltage), ShownSign::Magnitude);
        assert_eq!(shown_sign(&time, &current, &[3.7; 600]), ShownSign::Unclear);
        // Constant currents: a charge and a discharge in a file without a sign.
        let constant = vec![1.0; 200];
        let swing: Vec<f64> = (0..200).map(|n| 3.5 + 0.005 * f64::from(100 - (n - 100_i32).abs())).collect();
        assert_eq!(shown_sign(&time, &constant, &swing[..100]), ShownSign::Charge);
        let two: Vec<f64> = constant[..98].iter().chain(&[0.0, 0.0]).chain(&constant[..100]).copied().collect();
        assert_eq!(shown_sign(&time, &two, &swing), ShownSign::Magnitude);
    }
}
