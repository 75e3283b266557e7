//! The size of a page of a long life, and the text of a page without data.

use super::*;
use crate::alarm::{AlarmState, Change, Rule, Severity};
use crate::cell::{Chemistry, Label};
use crate::findings::{Diagnosis, UnknownImbalance};
use crate::monitor::{Estimate, Event, EventKind, MeasuredValues};
use crate::quantity::{CellIndex, Mode, Timestamp};

#[test]
fn a_page_of_nothing_says_unknown_and_fetches_nothing() {
    let context = PageContext { title: "bus <7> & co".into(), ..PageContext::default() };
    let page = page(&Data::new(Origin::Replay), &context);
    assert!(page.contains("<h1>bus &lt;7&gt; &amp; co</h1>") && page.matches("unknown").count() > 8);
    for forbidden in ["http://", "https://", "<script", "url(", "src="] {
        let found = page.replace("style-src=", "").contains(forbidden);
        assert!(!found, "{forbidden} in the page");
    }
    assert!(!page.contains("NaN") && !page.contains("inf"), "a number that is none");
}

/// A pack of 96 cells over 600 half-cycles of three hours, each cell fading at its own pace, with a voltage reading per
/// cell every two minutes, and alarms that come and go in every tenth half-cycle.
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
        let (from, to) = if half % 2 == 1 { (Mode::Charge, Mode::Discharge) } else { (Mode::Discharge, Mode::Charge) };
        data.take_event(&at(EventKind::Mode { from, to }));
    }
    data
}

fn moment_s(half: u16, minute: u16) -> f64 {
    1.7e9 + 10_800.0 * f64::from(half) + 60.0 * f64::from(minute)
}

/// Repeats itself, but not soon.
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
        capacity_ah: capacity_ah(half, cell),
        capacity_std_ah: 0.02,
        usable_capacity_ah: Some(0.9 * capacity_ah(half, cell)),
        usable_capacity_std_ah: Some(0.02),
        resistance_ratio: 1.0 + 0.001 * f64::from(half) + 0.02 * noise(half, cell),
        resistance_ratio_std: 0.05,
    }
}

fn alarm(half: u16, active: bool) -> EventKind {
    EventKind::Alarm {
        rule: Rule::CapacityLow,
        cell: Some(CellIndex(half % 96)),
        change: if active { Change::Raised } else { Change::Cleared },
        state: if active { AlarmState::Active } else { AlarmState::Inactive },
        active,
        severity: Severity::Warning,
        value: Some(capacity_ah(half, half % 96)),
        probability: Some(0.9),
        threshold: 1.82,
        occurrences: 1,
        acknowledged: false,
    }
}

#[test]
fn a_life_of_600_half_cycles_of_96_cells_fits_into_five_megabytes_with_everything_in_it() {
    let model = crate::config::of_label(&Label::usual(Chemistry::Nmc811Graphite, 2.6));
    let diagnosis = Diagnosis::new(96);
    let imbalance = Some(Err(UnknownImbalance::NotCompared));
    let title = "pack".into();
    let context = PageContext { title, model, diagnosis: Some(&diagnosis), imbalance, ..PageContext::default() };
    let page = page(&life(), &context);
    println!("{} bytes", page.len());
    assert!(page.len() < 5_000_000, "{} bytes", page.len());
    for part in [
        "State of charge over",
        "forecast, 5 to 95 %",
        "Capacity of every cell",
        "Recharge period",
        "Innovation",
        "What would help most",
        "unknown: the cells were not compared yet",
    ] {
        assert!(page.contains(part), "no {part}");
    }
    assert!(!page.contains("class=\"none\""), "a part has no picture");
    assert!(!page.contains("NaN") && !page.contains("inf\""), "a number that is none");
}

#[test]
fn the_menu_has_the_order_of_the_page() {
    let page = page(&Data::new(Origin::Replay), &PageContext::default());
    let menu: Vec<&str> = page.split("<a href=\"#").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    let headings = page.split("<h2").skip(1).filter_map(|rest| rest.split("id=\"").nth(1)?.split('"').next());
    assert_eq!(menu, headings.collect::<Vec<_>>());
    assert!(menu.len() == SECTIONS.len() + 2 && menu.contains(&"alarms"), "{menu:?}");
}

#[test]
fn the_pack_of_a_history_stands_under_the_title() {
    let mut data = Data::new(Origin::Store);
    data.source.pack = Some(3);
    assert!(page(&data, &PageContext::default()).contains("pack 3 of this history"));
}
