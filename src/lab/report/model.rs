//! Creates the section "How well the battery is known": rows that describe the cell model, and advice on useful
//! measurements.

use super::context::PageContext;
use super::data::{Data, ModelRecord};
use super::format;
use crate::cell::model_bands::CURVE_C;
use crate::cell::{Coverage, ModelBands, advise};
use crate::config::cell_model::{KnownBy, SourcedModel, state_words};

const SOC_STEPS: u32 = 20;
/// SOC at which resistances are stated.
const HALF: f64 = 0.5;

/// Returns rows of name and value; empty = the model is unknown.
pub(super) fn rows(data: &Data, context: &PageContext<'_>) -> Vec<(String, String)> {
    let Some(sourced) = &context.model else { return Vec::new() };
    let bands = ModelBands::new(&sourced.model);
    let mut rows = vec![
        ("Model", sourced.model.name.clone()),
        ("State", state_words(sourced.source.state).to_owned()),
        ("Open-circuit curve", curve(&bands)),
        ("Resistance at half charge", resistance(sourced, &bands)),
        ("Capacity", format!("\u{b1} {:.0} % before a cell's own is learned", 100.0 * bands.capacity_std())),
    ];
    if let Some(learned) = &sourced.source.learned {
        rows.push(("Range of the data it is learned from", seen(&learned.seen)));
        let residual = learned.residual_v.map(|v| format!("{} fits, residuals {:.1} mV", learned.fits, 1e3 * v));
        rows.push(("Learning", residual.unwrap_or_else(|| "nothing fitted yet".to_owned())));
        let better = learned.chemistry.map(|better| format!("{}: check the label", better.name()));
        rows.extend(better.map(|better| ("Chemistry that fits better", better)));
    }
    rows.push(("Range of this record", seen(&data.trace.seen)));
    rows.push(("SOC without data", unknown_soc(sourced)));
    rows.push(("Temperature without data", unknown_temperatures(sourced)));
    let points = advise(&bands).map(|(points, _)| format!("about {points:.1} points"));
    rows.push((
        "Expected error of the SOC in use",
        points.unwrap_or_else(|| "unknown: the model states no error".to_owned()),
    ));
    rows.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}

pub(super) fn changes(data: &Data) -> impl Iterator<Item = Vec<String>> {
    data.models.iter().rev().map(|change| {
        let ModelRecord { time_s, state, capacity_ah, residual_v, chemistry, is_taken_back } = change;
        let note = match (is_taken_back, chemistry.as_str()) {
            (true, _) => "the previous model applies again".to_owned(),
            (false, "") => String::new(),
            (false, better) => format!("{better} fits better"),
        };
        vec![
            format::moment(data, *time_s),
            state.clone(),
            capacity_ah.map_or("the label's".to_owned(), |(mean, std)| format!("{mean:.3} \u{b1} {std:.3} Ah")),
            residual_v.map_or(String::new(), |v| format!("{:.1} mV", 1e3 * v)),
            note,
        ]
    })
}

/// Returns the measurements that would reduce the SOC error most, as sentences; `None` = unknown.
pub(super) fn advice(context: &PageContext<'_>) -> Option<Vec<String>> {
    let (_, advice) = advise(&ModelBands::new(&context.model.as_ref()?.model))?;
    Some(advice.iter().map(sentence).collect())
}

pub(super) fn sentence(advice: &crate::cell::Advice) -> String {
    format!("{} (error then: {:.1} points)", advice.measurement, advice.left_points)
}

fn curve(bands: &ModelBands<'_>) -> String {
    let std_v = (2..=18).map(|k| bands.curve_std_v(soc(k))).collect::<Option<Vec<f64>>>();
    let mean_square = |values: Vec<f64>| values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64;
    std_v.map(mean_square).map_or_else(
        || "unknown: the model states no error".to_owned(),
        |square| format!("\u{b1} {:.0} mV between 10 and 90 %", 1e3 * square.sqrt()),
    )
}

fn soc(step: u32) -> f64 {
    f64::from(step) / f64::from(SOC_STEPS)
}

fn resistance(sourced: &SourcedModel, bands: &ModelBands<'_>) -> String {
    let at = |t: f64| {
        let milliohm = 1e3 * sourced.model.settled_ohm(&sourced.model.grid_position(HALF, t));
        format!("{milliohm:.2} m\u{3a9} \u{b1} {:.0} % at {t:.0} \u{b0}C", 100.0 * bands.resistance(HALF, t).std())
    };
    format!("{}, {}", at(CURVE_C), at(0.0))
}

fn seen(coverage: &Coverage) -> String {
    if coverage.is_empty() {
        return "unknown: nothing was recorded".to_owned();
    }
    format!(
        "{:.0} % of the SOC ({}), {}",
        100.0 * coverage.soc_share(),
        ranges(&coverage.soc_ranges(), 100.0, "%"),
        ranges(&coverage.temperature_ranges_c(), 1.0, "\u{b0}C")
    )
}

fn ranges(ranges: &[[f64; 2]], factor: f64, unit: &str) -> String {
    let words = ranges.iter().map(|[low, high]| format!("{:.0} to {:.0}", factor * low, factor * high));
    let words: Vec<String> = words.collect();
    if words.is_empty() { "temperature unknown".to_owned() } else { format!("{} {unit}", words.join(" and ")) }
}

fn unknown_soc(sourced: &SourcedModel) -> String {
    let nodes = (0..=SOC_STEPS).map(|k| (soc(k), sourced.curve_known_by(soc(k))));
    unknown(nodes, 100.0, "%")
}

fn unknown_temperatures(sourced: &SourcedModel) -> String {
    unknown(
        [-20.0, -10.0, 0.0, 10.0, 20.0, 30.0, 40.0, 50.0].into_iter().map(|t| (t, sourced.resistances_known_by(t))),
        1.0,
        "\u{b0}C",
    )
}

/// Lists the ranges without data, each with the source that replaces the data.
fn unknown(places: impl Iterator<Item = (f64, KnownBy)>, factor: f64, unit: &str) -> String {
    let places: Vec<(f64, KnownBy)> = places.collect();
    let is_known = |known_by: &KnownBy| matches!(known_by, KnownBy::Measured | KnownBy::Data);
    let run = |run: &[(f64, KnownBy)]| match (run.first(), run.last()) {
        (Some((low, known_by)), Some((high, _))) if !is_known(known_by) => {
            let (low, high) = (factor * low, factor * high);
            let place = if low == high { format!("{low:.0}") } else { format!("{low:.0} to {high:.0}") };
            Some(format!("{place} {unit} ({})", known_by.words()))
        }
        _ => None,
    };
    let runs: Vec<String> = places.chunk_by(|a, b| a.1 == b.1).filter_map(run).collect();
    if runs.is_empty() { "none".to_owned() } else { runs.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cell::{Chemistry, Label};
    use crate::config::of_label;
    use crate::report::Origin;

    #[test]
    fn prior_model_lists_missing_data_and_advice() {
        let model = of_label(&Label::usual(Chemistry::NcaGraphite, 2.9));
        let context = PageContext { model, ..PageContext::default() };
        let mut data = Data::new(Origin::Replay);
        data.trace.seen.note(0.55, 21.0);
        let rows = rows(&data, &context);
        let value = |name: &str| rows.iter().find(|row| row.0 == name).map(|row| row.1.clone()).expect("a row");
        assert_eq!(value("SOC without data"), "0 to 100 % (prior)");
        assert_eq!(value("Temperature without data"), "-20 to 50 \u{b0}C (prior)");
        assert_eq!(value("Range of this record"), "10 % of the SOC (50 to 60 %), 20 to 30 \u{b0}C");
        assert!(value("State").starts_with("label only"));
        let advice = advice(&context).expect("known");
        assert!(!advice.is_empty() && advice[0].contains("error then"), "{advice:?}");
    }

    #[test]
    fn model_changes_are_listed_latest_first() {
        use crate::monitor::{Event, EventKind, ModelState};
        use crate::quantity::Timestamp;
        let change = |seconds: f64, state, capacity_ah: Option<f64>, chemistry, is_taken_back| {
            let (capacity_std_ah, residual_v) = (capacity_ah.map(|_| 0.05), capacity_ah.map(|_| 0.0034));
            let kind = EventKind::Model { state, capacity_ah, capacity_std_ah, residual_v, chemistry, is_taken_back };
            Event { time: Timestamp::from_secs(seconds), kind }
        };
        let mut data = Data::new(Origin::Replay);
        let lfp = Some(Chemistry::LfpGraphite);
        let learning = change(1.8e9, ModelState::Learning, Some(4.7), None, false);
        let back = change(1.8e9 + 60.0, ModelState::Prior, None, None, true);
        let unfit = change(1.8e9 + 120.0, ModelState::Unfit, None, lfp, false);
        [learning, back, unfit].iter().for_each(|event| data.take_event(event));
        let rows: Vec<String> = changes(&data).map(|row| row.join(" | ")).collect();
        let expected = [
            "2027-01-15 08:02:00 UTC | unfit | the label's |  | lfp-graphite fits better",
            "2027-01-15 08:01:00 UTC | prior | the label's |  | the previous model applies again",
            "2027-01-15 08:00:00 UTC | learning | 4.700 \u{b1} 0.050 Ah | 3.4 mV | ",
        ];
        assert_eq!(rows, expected);
    }

    #[test]
    fn places_without_data_are_joined_by_reason() {
        use KnownBy::{Extrapolated, Measured};
        let places = [(0.0, Measured), (0.5, Measured), (0.6, Extrapolated), (0.8, Extrapolated), (1.0, Measured)];
        assert_eq!(unknown(places.into_iter(), 100.0, "%"), "60 to 80 % (extrapolated)");
        assert_eq!(unknown(places[..2].iter().copied(), 1.0, "%"), "none");
    }

    #[test]
    fn unknown_model_gives_no_rows() {
        let context = PageContext::default();
        assert!(rows(&Data::new(Origin::Store), &context).is_empty() && advice(&context).is_none());
    }
}
