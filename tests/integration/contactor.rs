//! Tests contactor states. If the contactors report open, the current counts as 0, whatever the sensor reads. A
//! contactor state that is not received counts as unknown.

use packwatch::monitor::Downtime;
use packwatch::quantity::catalogue::Quantity;
use packwatch::quantity::{CellIndex, Channel, Mode};

use crate::support::rig::Rig;

const CONTACTOR: &str = "[input.contactor]\nsignal = \"Status.Contactor\"\nopen = [0, 3]\nmax_age_s = 4.0\n";

fn rig() -> Rig {
    let mut rig = Rig::new(CONTACTOR);
    (rig.current_a, rig.contactor) = (Some(1.0), Some(1.0));
    rig.seconds(10);
    rig
}

fn current_a(rig: &Rig) -> Option<f64> {
    rig.monitor.pack_view().values.mean(Quantity::Current)
}

fn soc(rig: &Rig) -> f64 {
    let of_first = rig.monitor.cell_views().next().and_then(|cell| cell.values.mean(Quantity::Soc));
    of_first.expect("an estimate")
}

#[test]
fn contactor_state_selects_zero_or_measured_current() {
    let mut rig = rig();
    assert_eq!((current_a(&rig), rig.monitor.mode()), (Some(1.0), Mode::Discharge));
    for open in [0.0, 3.0] {
        rig.contactor = Some(open);
        rig.seconds(20);
        assert_eq!((current_a(&rig), rig.monitor.mode()), (Some(0.0), Mode::Rest), "{open}");
        assert_eq!(rig.monitor.cell_views().next().and_then(|cell| cell.values.mean(Quantity::Current)), Some(0.0));
        rig.contactor = Some(2.0);
        rig.seconds(10);
        assert_eq!((current_a(&rig), rig.monitor.mode()), (Some(1.0), Mode::Discharge), "{open}");
    }
}

#[test]
fn open_contactors_replace_missing_current() {
    let mut rig = rig();
    (rig.current_a, rig.contactor) = (None, Some(0.0));
    rig.seconds(30);
    assert_eq!((current_a(&rig), rig.monitor.mode()), (Some(0.0), Mode::Rest));
    assert!(rig.monitor.lost_inputs().eq([Channel::Current]), "the input must still be reported missing");
    // If the contactors are closed or their state is unknown, the current is unknown.
    rig.contactor = Some(1.0);
    rig.seconds(1);
    assert_eq!(current_a(&rig), None);
}

#[test]
fn stale_contactor_state_uses_measured_current() {
    let mut rig = rig();
    rig.contactor = Some(0.0);
    rig.seconds(5);
    rig.contactor = None;
    rig.seconds(3);
    assert_eq!(current_a(&rig), Some(0.0), "the contactor state is not stale yet");
    rig.seconds(3);
    assert_eq!(current_a(&rig), Some(1.0));
    assert!(rig.monitor.lost_inputs().eq([Channel::Contactor]));
    // While no valid contactor state has been received, the measured current is used.
    let mut silent = Rig::new(CONTACTOR);
    silent.current_a = Some(1.0);
    silent.seconds(10);
    assert_eq!(current_a(&silent), Some(1.0));
}

#[test]
fn restart_with_open_contactors_is_deterministic() {
    let run = |restarts: bool| {
        let mut rig = rig();
        rig.contactor = Some(0.0);
        rig.seconds(10);
        if restarts {
            rig.restart(Downtime::Seconds(0.0));
        }
        rig.seconds(10);
        rig.contactor = Some(1.0);
        rig.seconds(10);
        let cells: Vec<_> = [0, 1].map(|cell| rig.monitor.capacity(CellIndex(cell))).to_vec();
        (rig.frames.clone(), cells, soc(&rig), rig.monitor.mode())
    };
    let (first, restarted) = (run(false), run(true));
    assert_eq!(first, run(false));
    // Even a restart that takes 0 s counts as a downtime, so the SOC may change by up to 0.001.
    assert!((first.2 - restarted.2).abs() < 1e-3 && first.3 == restarted.3, "{} {}", first.2, restarted.2);
}
