//! What a restart and time asleep do to estimates and alarms, on hand-made frames of a pack of two cells.
#![allow(clippy::unwrap_used, reason = "a test")]

mod rig;

use packwatch::monitor::{Away, EventKind};
use packwatch::quantity::CellIndex;
use rig::{Rig, learned};

impl Rig {
    fn soc_std(&self, cell: usize) -> f64 {
        self.monitor.latest().nth(cell).unwrap().unwrap().soc_std
    }

    fn gaps(&self) -> Vec<Option<f64>> {
        let of = |kind| if let EventKind::Gap { seconds } = kind { Some(seconds) } else { None };
        self.events.iter().filter_map(|event| of(event.kind)).collect()
    }
}

#[test]
fn after_an_unknown_time_away_nothing_is_sure_but_what_was_learned() {
    let mut rig = learned();
    let (capacity, before) = (rig.monitor.capacity(CellIndex(1)), rig.soc_std(0));
    // Nobody measures the current: only the gap speaks.
    rig.current_a = None;
    rig.restart(Away::Unknown);
    rig.seconds(1);
    assert_eq!(rig.gaps(), [None]);
    assert!(before < 0.05 && rig.soc_std(0) > 0.25, "{before} {}", rig.soc_std(0));
    assert_eq!(rig.monitor.capacity(CellIndex(1)), capacity);
}

#[test]
fn a_state_from_the_future_is_of_unknown_age() {
    let mut rig = learned();
    (rig.current_a, rig.deci) = (None, rig.deci - 36_000);
    rig.restart(Away::AsStamped);
    rig.seconds(1);
    assert_eq!(rig.gaps(), [None]);
    assert!(rig.soc_std(0) > 0.25, "{}", rig.soc_std(0));
    // Interfaces that merge out of order are no clock that was set.
    let mut rig = learned();
    (rig.current_a, rig.deci) = (None, rig.deci - 5);
    rig.restart(Away::AsStamped);
    rig.seconds(1);
    assert_eq!(rig.gaps(), []);
    assert!(rig.soc_std(0) < 0.05, "{}", rig.soc_std(0));
}

/// What was learned, as it is stored: capacities with what drifts beside them, and the filters' resistances.
fn learned_parts(rig: &Rig) -> Vec<serde_json::Value> {
    let document = serde_json::to_value(rig.monitor.snapshot()).unwrap();
    let learner = &document["learner"];
    let mut parts = vec![learner["capacity"].clone(), learner["drift"].clone(), learner["learned"].clone()];
    for cell in document["cells"].as_array().unwrap() {
        let mean = cell["estimator"]["mean"].as_array().unwrap();
        // SOC and branches before it, capacity behind it.
        parts.push(mean[mean.len() - 2].clone());
        parts.extend([cell["usable"].clone(), cell["discharge_resistance"].clone()]);
    }
    parts
}

#[test]
fn what_was_learned_survives_every_restart_bit_for_bit() {
    for away in [Away::Seconds(0.5), Away::Seconds(3.0), Away::Seconds(3e4), Away::Seconds(3e8), Away::Unknown] {
        let mut rig = learned();
        let before = learned_parts(&rig);
        assert!(before[0].to_string().contains("mean") && before[2].to_string().contains("true"));
        for _ in 0..3 {
            rig.restart(away);
            rig.tick();
            assert_eq!(learned_parts(&rig), before, "{away:?}");
        }
    }
}
