//! Tests the size of the page for a long life, the text of a page without data, and the cards and alarms of a worn
//! pack.

use super::*;
use crate::alarm::{AlarmState, Change, Rule, Severity};
use crate::cell::{Chemistry, Label};
use crate::cell_faults::{CellFaultDetector, UnknownImbalance};
use crate::health::{InsufficientData, UseRecord};
use crate::monitor::{Estimate, Event, EventKind, MeasuredValues};
use crate::quantity::catalogue::{Quantity, RecordedValues};
use crate::quantity::{CellIndex, Mode, Timestamp};
use crate::report::examples::{self, HALVES, end_s};

#[test]
fn page_without_data_says_unknown_and_fetches_nothing() {
    let context = PageContext { title: "bus <7> & co".into(), ..PageContext::default() };
    let page = page(&Data::new(Origin::Replay), &context);
    assert!(page.contains("<h1>bus &lt;7&gt; &amp; co</h1>") && page.to_lowercase().matches("unknown").count() > 6);
    for forbidden in ["http://", "https://", "<script", "url(", "src="] {
        let found = page.replace("style-src=", "").contains(forbidden);
        assert!(!found, "{forbidden} in the page");
    }
    assert!(!page.contains("NaN") && !page.contains("inf"), "not a number in the text");
}

/// Creates the life of a pack of 96 cells: 600 half-cycles of three hours. Each cell fades at its own rate and has a
/// voltage reading every two minutes. In every tenth half-cycle, an alarm of one cell is raised. In the following
/// half-cycle, an alarm of the next cell is cleared.
fn life() -> Data {
    let mut data = Data::new(Origin::Replay);
    for half in 0..600_u16 {
        for minute in (0..180_u16).step_by(2) {
            (0..96).for_each(|cell| data.take_estimate(&estimate(half, minute, cell)));
        }
        let at = |kind| Event { time: Timestamp::from_secs(moment_s(half, 180)), kind };
        for cell in 0..96 {
            data.take_event(&at(half_cycle(half, cell)));
            data.take_event(&at(capacity(half, cell)));
        }
        if half % 2 == 1 {
            let seconds = Some(8000.0 - 3.0 * f64::from(half));
            let kind = EventKind::RechargePeriod { seconds, normalised_s: seconds, normalised_std_s: Some(60.0) };
            data.take_event(&at(kind));
        }
        if half % 10 < 2 {
            data.take_event(&at(alarm(half, half % 10 == 0)));
        }
    }
    data
}

fn moment_s(half: u16, minute: u16) -> f64 {
    1.7e9 + 10_800.0 * f64::from(half) + 60.0 * f64::from(minute)
}

fn noise(a: u16, b: u16) -> f64 {
    (f64::from(a) * 12.9898 + f64::from(b) * 78.233).sin()
}

fn capacity_ah(half: u16, cell: u16) -> f64 {
    2.6 - (0.0008 + 0.000_003 * f64::from(cell)) * f64::from(half) + 0.02 * noise(cell, 7)
}

fn estimate(half: u16, minute: u16, cell: u16) -> Estimate {
    let part = f64::from(minute) / 180.0;
    Estimate {
        time: Timestamp::from_secs(moment_s(half, minute)),
        cell: CellIndex(cell),
        soc: 0.05 + 0.9 * if half % 2 == 1 { part } else { 1.0 - part } + 0.01 * noise(cell, 3),
        soc_std: 0.01,
        branch_v: [0.0; crate::cell::MAX_BRANCHES],
        capacity_ah: capacity_ah(half, cell),
        capacity_std_ah: 0.02,
        resistance_ratio: 1.0,
        resistance_ratio_std: 0.1,
        innovation_v: 0.01 * noise(half.wrapping_mul(180).wrapping_add(minute), cell),
        innovation_std_v: 0.006,
        accepted: true,
        measured: MeasuredValues { voltage_v: 3.7, current_a: 1.0, temperature_c: 25.0 + 5.0 * noise(half, minute) },
    }
}

fn half_cycle(half: u16, cell: u16) -> EventKind {
    EventKind::HalfCycle {
        cell: CellIndex(cell),
        mode: if half % 2 == 1 { Mode::Charge } else { Mode::Discharge },
        charge_ah: 0.9 * capacity_ah(half, cell),
        swing: Some(0.9),
        swing_std: Some(0.01),
        duration_s: 10_000.0,
        mean_current_a: 1.0,
        mean_temperature_c: Some(25.0),
    }
}

fn capacity(half: u16, cell: u16) -> EventKind {
    EventKind::Capacity {
        cell: CellIndex(cell),
        measured_ah: Some(capacity_ah(half, cell) + 0.01 * noise(half, cell)),
        measured_std_ah: Some(0.01),
        values: RecordedValues::default()
            .with(Quantity::Capacity, Some((capacity_ah(half, cell), 0.02)))
            .with(Quantity::UsableCapacity, Some((0.9 * capacity_ah(half, cell), 0.02)))
            .with(Quantity::ResistanceRatio, Some((1.0 + 0.001 * f64::from(half) + 0.02 * noise(half, cell), 0.05))),
    }
}

fn alarm(half: u16, active: bool) -> EventKind {
    change(Rule::CapacityLow, half % 96, active, capacity_ah(half, half % 96))
}

fn change(rule: Rule, cell: u16, active: bool, value: f64) -> EventKind {
    EventKind::Alarm {
        rule,
        cell: Some(CellIndex(cell)),
        change: if active { Change::Raised } else { Change::Cleared },
        state: if active { AlarmState::Active } else { AlarmState::Inactive },
        active,
        severity: Severity::Warning,
        value: Some(value),
        probability: Some(0.9),
        threshold: 1.82,
        occurrences: 1,
        acknowledged: false,
    }
}

#[test]
fn page_of_a_long_life_stays_below_five_megabytes() {
    let model = crate::config::of_label(&Label::usual(Chemistry::Nmc811Graphite, 2.6));
    let diagnosis = CellFaultDetector::new(96);
    let imbalance = Some(Err(UnknownImbalance::NotCompared));
    let title = "pack".into();
    let use_record = Some(UseRecord::default());
    let diagnosis = Some(&diagnosis);
    let context = PageContext { title, model, diagnosis, imbalance, use_record, ..PageContext::default() };
    let page = page(&life(), &context);
    println!("{} bytes", page.len());
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
    for part in [
        "State of charge over",
        "forecast, 5 to 95 %",
        "Recharge period",
        "Innovation",
        "Measurements that would help most",
        "unknown: the cells have not been compared yet",
    ] {
        assert!(page.contains(part), "no {part}");
    }
    assert!(page.contains("No cell stands out in: loss of charge, contact resistance,"), "pictures without a finding");
    assert_eq!(page.matches("class=\"none\"").count(), 0, "a section is empty");
    assert!(!page.contains("NaN") && !page.contains("inf\""), "not a number in the text");
}

#[test]
fn menu_follows_the_order_of_the_page() {
    let page = page(&Data::new(Origin::Replay), &PageContext::default());
    let menu: Vec<&str> = page.split("<a href=\"#").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    // Titles are headings and the lines of empty sections.
    let is_title = |tag: &&str| tag.starts_with("h2") || tag.starts_with("p class=\"none\" id");
    let titles = page.split('<').filter(is_title).filter_map(|rest| rest.split("id=\"").nth(1)?.split('"').next());
    assert_eq!(menu, titles.collect::<Vec<_>>());
    assert!(menu.len() == SECTIONS.len() + 5 && menu.contains(&"alarms"), "{menu:?}");
}

#[test]
fn pack_of_a_history_is_in_the_heading() {
    let mut data = Data::new(Origin::Store);
    data.source.pack = Some(3);
    assert!(page(&data, &PageContext::default()).contains("pack 3 of this history"));
}

const PLUS_MINUS: char = '\u{b1}';

struct Card<'a> {
    name: &'a str,
    text: String,
    doubt: Option<&'a str>,
}

fn between<'a>(text: &'a str, from: &str, to: &str) -> Option<&'a str> {
    text.split_once(from)?.1.split(to).next()
}

fn cards(page: &str) -> Vec<Card<'_>> {
    let tiles = between(page, "<div class=\"tiles\">", "<section>").expect("cards");
    let card = |tile| {
        let part = |class: &str| between(tile, &format!("<div class=\"{class}\">"), "</div>");
        let [name, value, note] = ["name", "value", "note"].map(|class| part(class).expect("in every card"));
        Card { name, text: format!("{value}; {note}"), doubt: part("doubt") }
    };
    tiles.split("<div class=\"tile\">").skip(1).map(card).collect()
}

fn at_end(kind: EventKind) -> Event {
    Event { time: Timestamp::from_secs(end_s(HALVES - 1)), kind }
}

fn trust(cell: u16, trusted: bool) -> Event {
    at_end(EventKind::Trust { cell: CellIndex(cell), trusted, mean_nis: 4.0 })
}

#[test]
fn untrusted_cell_marks_every_card_with_an_estimate() {
    let config = examples::config();
    let context = PageContext { config: Some(&config), ..PageContext::default() };
    let mut data = examples::worn(96);
    data.take_event(&trust(6, false));
    let doubted = page(&data, &context);
    let marks: Vec<(&str, Option<&str>)> = cards(&doubted).iter().map(|card| (card.name, card.doubt)).collect();
    let mark = Some("not trusted: cell 7");
    let estimates = ["State of health", "Capacity", "Usable capacity", "Lithium lost", "Resistance", "Recharge period"];
    let counts = [("Use so far", None), ("Alarms raised now", None)];
    let expected: Vec<_> =
        estimates.into_iter().chain(["Remaining life"]).map(|name| (name, mark)).chain(counts).collect();
    assert_eq!(marks, expected);
    data.take_event(&trust(6, true));
    assert!(!page(&data, &context).contains("class=\"doubt\""), "trusted again");
}

#[test]
fn alarms_of_96_cells_are_one_problem() {
    let mut data = examples::worn(96);
    (0..96).for_each(|cell| data.take_event(&at_end(change(Rule::CapacityLow, cell, true, 1.8))));
    let raised = page(&data, &PageContext::default());
    let first = between(&raised, "<p class=\"head\">", "</p>").expect("a sentence");
    assert_eq!(first, "The capacity of cells 1 to 96 was below the limit of 1.82 Ah; now it is 2.147 Ah in cell 96.");
    assert!(raised.contains("Alarm capacity_low (warning) of cells 1 to 96 since"));
    let count = cards(&raised).into_iter().find(|card| card.name == "Alarms raised now").expect("a card");
    assert_eq!(count.text, "96; in this record: capacity_low at 1 time");
}

/// Returns the numbers after the plus-minus signs, each with half a unit of its last digit.
fn deviations(text: &str) -> Vec<(f64, f64)> {
    let number = |rest: &str| {
        let rest = rest.trim_start();
        let end = rest.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(rest.len());
        let digits = rest[..end].trim_end_matches('.');
        let decimals = digits.split_once('.').map_or(0, |(_, decimals)| decimals.len());
        let value = digits.parse().unwrap_or_else(|_| panic!("no number behind the sign: {rest}"));
        (value, 0.5 * 10.0_f64.powi(-i32::try_from(decimals).expect("few")))
    };
    text.split(PLUS_MINUS).skip(1).map(number).collect()
}

/// Whether the numbers after the plus-minus signs equal these standard deviations, rounded to the printed digits.
fn states(text: &str, stds: &[f64]) -> bool {
    let printed = deviations(text);
    let is_same = |((value, half_digit), std): (&(f64, f64), &f64)| (value - std).abs() <= half_digit + 1e-9;
    printed.len() == stds.len() && printed.iter().zip(stds).all(is_same)
}

#[test]
fn every_plus_minus_is_one_standard_deviation() {
    const STATEMENT: &str = "Every \u{b1} is one standard deviation.";
    let config = examples::config();
    let context = PageContext { config: Some(&config), ..PageContext::default() };
    let mut data = examples::worn(4);
    data.set_current_offset(Some((0.012, 0.034)));
    data.take_estimate(&estimate(0, 0, 0));
    let page = page(&data, &context);
    assert!(page.contains(STATEMENT));
    let [first, second, third, last] = [0, 1, 2, 3].map(examples::stds);
    // Standard deviation of each loss, for the cell with the largest loss.
    let [lithium, negative, positive] = [second.losses[0], third.losses[1], first.losses[2]].map(|std| 100.0 * std);
    for card in cards(&page) {
        let expected = match card.name {
            "State of health" => vec![100.0 * last.capacity_ah / 2.6],
            "Capacity" => vec![last.capacity_ah],
            "Usable capacity" => vec![first.usable_ah],
            "Lithium lost" => vec![lithium, negative, positive],
            "Resistance" => vec![first.resistance],
            _ => Vec::new(),
        };
        assert!(states(&card.text, &expected), "{}: {}, not {expected:?}", card.name, card.text);
    }
    let offset = between(&page, "reading minus true current</td><td>", "</td>").expect("a row");
    assert!(states(offset, &[0.034]), "{offset}");
    // The page has only these plus-minus signs: one in the statement, seven on cards, one for the offset.
    assert_eq!(page.matches(PLUS_MINUS).count(), 9);
    assert!(!page.contains("+-"), "another plus-minus sign");
}

#[test]
fn missing_forecast_states_the_reason() {
    let config = examples::config();
    let context = PageContext { config: Some(&config), ..PageContext::default() };
    let mut data = Data::new(Origin::Replay);
    for half in 0..2_u16 {
        let at = |kind| Event { time: Timestamp::from_secs(end_s(half)), kind };
        data.take_event(&at(half_cycle(half, 0)));
        data.take_event(&at(capacity(0, 0)));
    }
    let refused = forecast::cells(&data, &context)[0].remaining(config.monitor.health.end_of_life_ah);
    assert_eq!(refused, Err(InsufficientData::Readings { found: 2 }));
    let page = page(&data, &context);
    let why = between(&page, "<td>Remaining life</td><td>", "</td>").expect("a gap");
    assert!(why.starts_with("2 capacity readings, 3 are needed"), "{why}");
    assert!(!page.contains("+-"), "another plus-minus sign");
}
