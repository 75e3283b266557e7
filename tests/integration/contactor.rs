//! Contactors that say they are open: no current flows, whatever its sensor reports, and a state without news is unknown.

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
fn open_contactors_mean_no_current_and_closed_ones_the_measured_one() {
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
fn open_contactors_stand_in_for_a_current_that_is_missing() {
    let mut rig = rig();
    (rig.current_a, rig.contactor) = (None, Some(0.0));
    rig.seconds(30);
    assert_eq!((current_a(&rig), rig.monitor.mode()), (Some(0.0), Mode::Rest));
    assert!(rig.monitor.lost_inputs().eq([Channel::Current]), "the input is missing all the same");
    // Closed, or not known: nothing is known of the current.
    rig.contactor = Some(1.0);
    rig.seconds(1);
    assert_eq!(current_a(&rig), None);
}

#[test]
fn a_state_without_news_is_unknown_and_the_current_as_measured() {
    let mut rig = rig();
    rig.contactor = Some(0.0);
    rig.seconds(5);
    rig.contactor = None;
    rig.seconds(3);
    assert_eq!(current_a(&rig), Some(0.0), "still fresh");
    rig.seconds(3);
    assert_eq!(current_a(&rig), Some(1.0));
    assert!(rig.monitor.lost_inputs().eq([Channel::Contactor]));
    // Bad readings are none: before the first good one the current is as measured.
    let mut silent = Rig::new(CONTACTOR);
    silent.current_a = Some(1.0);
    silent.seconds(10);
    assert_eq!(current_a(&silent), Some(1.0));
}

#[test]
fn the_same_frames_give_the_same_outputs_also_over_a_restart_with_open_contactors() {
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
    // A restart of 0 s is a downtime all the same: the estimate is within what that may move it.
    assert!((first.2 - restarted.2).abs() < 1e-3 && first.3 == restarted.3, "{} {}", first.2, restarted.2);
}
