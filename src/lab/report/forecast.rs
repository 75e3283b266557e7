//! Forecasts the remaining life from the record with the monitor's own filter (`health::Forecast`), and computes the
//! fan that shows the forecast in the capacity chart.
//!
//! A store's rows and a replay's events both contain the filter's inputs, so both give the same result as the monitor.

use std::collections::BTreeMap;

use super::context::PageContext;
use super::data::{CapacityRecord, Data};
use super::limits::threshold;
use crate::alarm::Rule;
use crate::health::{Axis, CapacityReading, Forecast, InsufficientData, Remaining, RemainingLife, Usage};
use crate::quantity::DAY_S;

const POINTS: usize = 60;
/// The fan is at most this many times as long as the median time to the end of life.
const MAX_MEDIANS: f64 = 2.5;
/// The fan is at most this many times as long as the record. It may always be as long as the median time to the end of
/// life.
const MAX_RECORDS: f64 = 2.0;
/// The fan may be this many times as long as the record even if [`MAX_MEDIANS`] allows less. If the median time is
/// short, the end of life may come much later than the median.
const LEAST_RECORDS: f64 = 0.2;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct DatedFanPoint {
    pub(super) time_s: f64,
    /// 5 %, 50 % and 95 % quantile (Ah).
    pub(super) low_ah: f64,
    pub(super) median_ah: f64,
    pub(super) high_ah: f64,
}

/// Forecast for the cell whose life ends first, among the cells with a known remaining life.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Outlook {
    pub(super) cell: usize,
    /// Points for the capacity chart; empty = the end of life has passed, or the rate of use is unknown.
    pub(super) fan: Vec<DatedFanPoint>,
    pub(super) end_ah: f64,
    pub(super) life: RemainingLife,
    /// Reason why the life of some cells is unknown. One of these cells may reach its end of life first.
    pub(super) unknown: Option<String>,
}

/// Returns the capacity at the end of life (Ah) from the configuration. Without a configuration, it is the limit of the
/// least severe capacity alarm in the record.
pub(super) fn end_of_life_ah(data: &Data, context: &PageContext<'_>) -> Option<f64> {
    let configured = context.config.map(|config| config.monitor.health.end_of_life_ah);
    configured.or_else(|| threshold(data, context, Rule::CapacityLow))
}

/// Returns the forecast for the cell whose life ends first, or the reason why there is no forecast.
pub(super) fn outlook(data: &Data, context: &PageContext<'_>) -> Result<Outlook, String> {
    let end_ah = end_of_life_ah(data, context)
        .ok_or("the record does not state the capacity at the end of life; a configuration (-c) does")?;
    let cells = cells(data, context);
    let lives: Vec<Result<RemainingLife, InsufficientData>> = cells.iter().map(|cell| cell.remaining(end_ah)).collect();
    let refused = lives.iter().enumerate().find_map(|(cell, life)| Some((cell, life.err()?)));
    let unknown = refused.map(|(cell, why)| unknown_lives(&lives, cell, why));
    let median = |life: &RemainingLife| life.cycles.or(life.days).map_or(f64::INFINITY, |left| left.median);
    let known = lives.into_iter().enumerate().filter_map(|(cell, life)| Some((cell, life.ok()?)));
    match known.min_by(|a, b| median(&a.1).total_cmp(&median(&b.1))) {
        Some((cell, life)) => {
            // If the life of one cell is over, no other life can be shorter.
            let unknown = unknown.filter(|_| !is_over(&life));
            Ok(Outlook { cell, fan: fan(data, &cells[cell], &life), end_ah, life, unknown })
        }
        None => Err(unknown.unwrap_or_else(|| "nothing was learned about the capacity yet".to_owned())),
    }
}

fn is_over(life: &RemainingLife) -> bool {
    life.cycles.or(life.days).is_some_and(|left| left.high <= 0.0)
}

fn unknown_lives(lives: &[Result<RemainingLife, InsufficientData>], cell: usize, why: InsufficientData) -> String {
    if lives.len() == 1 {
        return why.to_string();
    }
    let unknown = lives.iter().filter(|life| life.is_err()).count();
    format!("unknown for {unknown} of {} cells (cell {}: {})", lives.len(), cell + 1, why)
}

/// Returns the forecast of every cell at the end of the record, from the same inputs as in `monitor::life`.
pub(super) fn cells(data: &Data, context: &PageContext<'_>) -> Vec<Forecast> {
    // Without a configuration, the default of `capacity.current_gain_std` applies.
    let gain_std = context.config.map_or(0.005, |config| config.monitor.health.capacity.current_gain_std);
    let key = |time_s: f64, cell: usize| (time_s.to_bits(), cell);
    let learned: BTreeMap<_, &CapacityRecord> =
        data.learned.iter().map(|row| (key(row.time_s, row.cell), row)).collect();
    let first_ah = data.learned.first().map_or(1.0, |row| row.capacity_ah.0);
    let rated_ah = |cell| context.rated_ah(cell).unwrap_or(first_ah);
    let mut cells: Vec<Forecast> = (0..data.cells()).map(|cell| Forecast::new(Axis::Cycles, rated_ah(cell))).collect();
    let mut before_s: Option<f64> = None;
    for halves in data.halves.chunk_by(|a, b| a.time_s == b.time_s) {
        let now_s = halves[0].time_s;
        let since_before_s = before_s.map(|before_s| now_s - before_s);
        for half in halves {
            let rated_ah = rated_ah(half.cell);
            let usage = Usage::in_half_cycle(half.charge_ah, half.duration_s, since_before_s, rated_ah);
            // A store omits capacities without new information, so a half-cycle without a capacity still counts as use.
            let row = learned.get(&key(half.time_s, half.cell));
            cells[half.cell].update(usage, row.and_then(|row| reading(row, gain_std)));
        }
        before_s = Some(now_s);
    }
    cells
}

fn reading(row: &CapacityRecord, gain_std: f64) -> Option<CapacityReading> {
    let (capacity_ah, std_ah) = row.measured_ah.zip(row.measured_std_ah)?;
    let gain_ah = gain_std * row.capacity_ah.0;
    Some(CapacityReading { capacity_ah, variance_ah2: std_ah * std_ah, shared_variance_ah2: gain_ah * gain_ah })
}

/// Returns points from the last half-cycle to the latest likely end of life, limited by [`MAX_MEDIANS`] and
/// [`MAX_RECORDS`].
fn fan(data: &Data, forecast: &Forecast, life: &RemainingLife) -> Vec<DatedFanPoint> {
    let (Some(cycles), Some(days)) = (life.cycles, life.days) else { return Vec::new() };
    let (Some(first), Some(last)) = (data.halves.first(), data.halves.last()) else { return Vec::new() };
    if is_over(life) {
        return Vec::new();
    }
    let days_per_cycle = days.high / cycles.high;
    let recorded = (last.time_s - first.time_s) / DAY_S / days_per_cycle;
    let long = (MAX_MEDIANS * cycles.median).max(LEAST_RECORDS * recorded);
    let ahead = cycles.high.min(long).min((MAX_RECORDS * recorded).max(cycles.median));
    let at = |point: crate::health::forecast::FanPoint| DatedFanPoint {
        time_s: last.time_s + point.ahead * days_per_cycle * DAY_S,
        low_ah: point.low_ah,
        median_ah: point.median_ah,
        high_ah: point.high_ah,
    };
    forecast.fan(ahead, POINTS).map_or_else(|_| Vec::new(), |points| points.into_iter().map(at).collect())
}

impl Outlook {
    pub(super) fn is_over(&self) -> bool {
        is_over(&self.life)
    }

    /// Returns for example "14 cycles". As in the monitor, the result is "unknown" if the life of another cell is
    /// unknown, unless this cell's life is over.
    pub(super) fn value(&self) -> String {
        match self.life.cycles {
            Some(left) if self.unknown.is_none() => median(left),
            _ => "unknown".to_owned(),
        }
    }

    pub(super) fn note(&self, cells: usize) -> String {
        let cycles = self.life.cycles.map_or_else(String::new, interval);
        if let Some(why) = &self.unknown {
            let shortest = self.life.cycles.map_or_else(String::new, median);
            return format!("{why}; shortest known: {shortest}, {cycles}, cell {}", self.cell + 1);
        }
        let of_cell = if cells > 1 { format!(" of cell {}", self.cell + 1) } else { String::new() };
        if self.is_over() {
            return format!("the capacity{of_cell} is below {:.3} Ah, the end of life", self.end_ah);
        }
        let days = self.life.days.map_or_else(String::new, |days| {
            format!("; at the recent rate of use {} days, {}", digits(days.median), interval(days))
        });
        format!("{cycles}, until the capacity{of_cell} is {:.3} Ah{days}", self.end_ah)
    }
}

fn median(left: Remaining) -> String {
    if left.high <= 0.0 { "none".to_owned() } else { format!("{} cycles", digits(left.median)) }
}

fn interval(left: Remaining) -> String {
    format!("{} to {} in nine of ten cases", digits(left.low), digits(left.high))
}

fn digits(value: f64) -> String {
    if value < 9.95 { format!("{value:.1}") } else { format!("{value:.0}") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::Origin;
    use crate::report::data::HalfCycleRecord;

    /// Creates half-cycles of three hours, one every six hours. In every half-cycle, each cell loses its own share of 2
    /// Ah.
    fn worn(halves: u32, losses: &[f64]) -> Data {
        let mut data = Data::new(Origin::Store);
        for half in 0..halves {
            let time_s = 1.7e9 + 21_600.0 * f64::from(half);
            for (cell, loss) in losses.iter().enumerate() {
                let capacity_ah = 2.0 * (1.0 - loss * f64::from(half));
                let (is_charge, duration_s) = (half % 2 == 1, 10_800.0);
                data.halves.push(HalfCycleRecord {
                    time_s,
                    cell,
                    is_charge,
                    charge_ah: capacity_ah,
                    duration_s,
                    mean_temperature_c: None,
                });
                data.learned.push(CapacityRecord {
                    time_s,
                    cell,
                    measured_ah: Some(capacity_ah),
                    measured_std_ah: Some(0.01),
                    capacity_ah: (capacity_ah, 0.01),
                    usable_ah: None,
                    losses: None,
                    resistance: (1.0, 0.1),
                });
            }
        }
        data
    }

    fn alarm_at(data: &mut Data, threshold: f64) {
        data.alarms.push(crate::report::data::AlarmRecord {
            time_s: 1.7e9,
            rule: "capacity_low".to_owned(),
            severity: "warning".to_owned(),
            cell: None,
            change: "raised".to_owned(),
            is_active: true,
            value: None,
            threshold: Some(threshold),
        });
    }

    #[test]
    fn fastest_fading_cell_is_reported_with_a_fan() {
        let mut data = worn(100, &[0.001, 0.0015, 0.001]);
        alarm_at(&mut data, 1.6);
        let outlook = outlook(&data, &PageContext::default()).expect("enough readings");
        assert_eq!((outlook.cell, outlook.end_ah), (1, 1.6));
        let left = outlook.life.cycles.expect("cycles");
        // A capacity of 1.7 Ah that falls linearly by 0.006 Ah per cycle reaches the end of life after 17 full cycles.
        // The median may differ, because the forecast also uses a prior: typical cells last longer.
        assert!(left.low < 17.0 && left.high > 17.0 && (8.5..25.0).contains(&left.median), "{left:?}");
        let (first, last) = (outlook.fan[0], outlook.fan[POINTS - 1]);
        assert_eq!(first.time_s, data.halves.last().map(|half| half.time_s).expect("halves"));
        assert!(last.median_ah < 1.6 && first.median_ah > 1.6 && last.low_ah < last.high_ah, "{last:?}");
        let crossed = outlook.fan.iter().find(|point| point.median_ah < 1.6).expect("crosses");
        let days = outlook.life.days.expect("days").median;
        assert!(((crossed.time_s - first.time_s) / DAY_S / days - 1.0).abs() < 0.1, "the median of both agrees");
        assert!(outlook.note(3).contains("of cell 2 is 1.600 Ah"), "{}", outlook.note(3));
    }

    #[test]
    fn too_little_data_is_rejected_with_a_reason() {
        let mut short = worn(2, &[0.001, 0.001]);
        assert!(outlook(&short, &PageContext::default()).unwrap_err().contains("a configuration (-c) does"));
        alarm_at(&mut short, 1.6);
        let why = outlook(&short, &PageContext::default()).unwrap_err();
        assert_eq!(why, "unknown for 2 of 2 cells (cell 1: 2 capacity readings, 3 are needed)");
        let mut mixed = worn(100, &[0.001, 0.0]);
        alarm_at(&mut mixed, 1.6);
        let outlook_of_both = outlook(&mixed, &PageContext::default()).expect("of both cells");
        assert_eq!((outlook_of_both.cell, outlook_of_both.unknown), (0, None));
        let mut flat = worn(100, &[0.0]);
        alarm_at(&mut flat, 1.6);
        let left = outlook(&flat, &PageContext::default()).expect("wide").life.cycles.expect("cycles");
        assert!(left.high > 10.0 * left.low, "{left:?}");
    }

    #[test]
    fn cell_past_its_end_has_no_fan() {
        let mut data = worn(100, &[0.0015]);
        alarm_at(&mut data, 1.9);
        let outlook = outlook(&data, &PageContext::default()).expect("known");
        assert_eq!((outlook.value().as_str(), outlook.fan.len()), ("none", 0));
        assert_eq!(outlook.note(1), "the capacity is below 1.900 Ah, the end of life");
    }
}
