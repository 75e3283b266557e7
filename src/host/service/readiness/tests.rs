//! Tests readiness reports, and the status line about interfaces, lost signals and reloads.

use super::*;
use crate::can::{CanId, Frame};
use crate::config;
use crate::monitor::{MonitorConfig, Outputs, Record};
use crate::quantity::{BusIndex, Timestamp};
use std::path::Path;

/// A monitor and its readiness state, with the simulated time of both.
struct Scene {
    monitor: Monitor,
    readiness: Readiness,
    began: Instant,
    at_s: f64,
}

impl Scene {
    fn new(restored: Option<String>) -> Self {
        Self::with(restored, |_| {})
    }

    fn with(restored: Option<String>, edit: impl FnOnce(&mut MonitorConfig)) -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../config/paper.toml");
        let mut config = config::load(&path).expect("the example is good");
        edit(&mut config.monitor);
        let names: Vec<_> = ["can0", "can1"].map(str::to_owned).to_vec();
        let began = Instant::now();
        let readiness = Readiness::new(&names, Duration::from_secs(10), restored, began);
        Self { monitor: Monitor::new(config.monitor), readiness, began, at_s: 0.0 }
    }

    /// Feeds one input, `after_s` after the previous one.
    fn feed(&mut self, after_s: f64, record: impl Fn(Timestamp) -> Record) -> ManagerUpdate {
        self.at_s += after_s;
        let mut out = Outputs::default();
        self.monitor.handle(&record(Timestamp::from_secs(1e9 + self.at_s)), &mut out);
        out.events.iter().for_each(|event| self.readiness.note(event));
        self.readiness.poll(&self.monitor, self.began + Duration::from_secs_f64(self.at_s))
    }

    fn tick(&mut self, after_s: f64) -> ManagerUpdate {
        self.feed(after_s, Record::tick)
    }

    fn bus(&mut self, after_s: f64, bus: u8, event: BusEvent) -> ManagerUpdate {
        self.feed(after_s, |time| Record::bus(time, BusIndex(bus), event))
    }

    /// Runs ticks for `seconds`. Returns the last line reported in this time, if any.
    fn wait(&mut self, seconds: u32) -> Option<String> {
        (0..seconds * 10).filter_map(|_| self.tick(0.1).status).last()
    }
}

/// A frame that fits the example's DBC: 3.7 V, 0 A, 25 degrees C.
fn good_frame() -> &'static Frame {
    leaked(0x100, &[0x50, 0xA5, 0x05, 0, 0, 0, 0xC4, 0x09])
}

fn leaked(id: u16, data: &[u8]) -> &'static Frame {
    Box::leak(Box::new(Frame::classic(CanId::Standard(id), data).expect("at most eight bytes")))
}

#[test]
fn service_is_ready_with_first_usable_reading() {
    let mut scene = Scene::new(None);
    assert_eq!(
        scene.tick(0.0),
        ManagerUpdate { ready: false, status: Some("waiting for the first usable reading".to_owned()) }
    );
    assert!(!scene.bus(0.1, 0, BusEvent::Up).ready);
    // A frame that carries no configured signal does not count.
    let foreign = leaked(0x7FE, &[1]);
    assert!(!scene.feed(0.1, |time| Record::frame(time, BusIndex(0), foreign)).ready);
    let frame = good_frame();
    let update = scene.feed(0.2, |time| Record::frame(time, BusIndex(0), frame));
    let status = Some("running: 2 interfaces, first reading after 0.4 s".to_owned());
    assert_eq!(update, ManagerUpdate { ready: true, status });
    assert!(!scene.tick(5.0).ready, "readiness is reported once");
}

#[test]
fn service_without_input_is_ready_after_wait() {
    let mut scene = Scene::new(Some(describe_restored(Some(12.4))));
    scene.bus(0.0, 0, BusEvent::Up);
    scene.bus(0.1, 1, BusEvent::Missing);
    assert!(!scene.tick(9.8).ready);
    let update = scene.tick(0.1);
    assert!(update.ready);
    let line = update.status.expect("a line");
    assert_eq!(line, "running without input: no usable reading in 10 s, restored state 12 s old; can1 is missing");
    // The first frame is reported even after the end of the wait.
    let frame = good_frame();
    scene.feed(1.5, |time| Record::frame(time, BusIndex(0), frame));
    assert_eq!(
        scene.readiness.reported,
        "running: 2 interfaces, first reading after 11.5 s, restored state 12 s old; can1 is missing"
    );
}

#[test]
fn status_line_changes_at_most_once_a_second() {
    let mut scene = Scene::new(None);
    let frame = good_frame();
    scene.feed(0.0, |time| Record::frame(time, BusIndex(0), frame));
    let mut reports = 0;
    for n in 0..40 {
        let event = if n % 2 == 0 { BusEvent::Down } else { BusEvent::Missing };
        reports += usize::from(scene.bus(0.05, 0, event).status.is_some());
    }
    assert!(reports <= 3, "{reports} lines in 2 s");
    scene.wait(2);
    assert!(scene.readiness.reported.ends_with("; can0 is missing"), "{}", scene.readiness.reported);
}

#[test]
fn lost_signals_are_counted_and_named() {
    let mut scene = Scene::with(None, |config| config.asleep_after_s = None);
    let frame = good_frame();
    scene.feed(0.0, |time| Record::frame(time, BusIndex(0), frame));
    // 130 s are longer than the maximum age of a temperature.
    let line = scene.wait(130).expect("signals were lost");
    assert!(line.starts_with("running without input; 3 of 3 signals lost (pack current, "), "{line}");
    for _ in 0..20 {
        scene.feed(0.1, |time| Record::frame(time, BusIndex(0), frame));
    }
    assert_eq!(scene.readiness.reported, "running: 2 interfaces, first reading after 0.0 s");
}

#[test]
fn parked_vehicle_is_asleep_without_lost_signals() {
    let mut scene = Scene::new(None);
    let frame = good_frame();
    scene.feed(0.0, |time| Record::frame(time, BusIndex(0), frame));
    assert_eq!(scene.wait(130).as_deref(), Some("running: buses asleep"));
    for _ in 0..20 {
        scene.feed(0.1, |time| Record::frame(time, BusIndex(0), frame));
    }
    assert_eq!(scene.readiness.reported, "running: 2 interfaces, first reading after 0.0 s");
}

#[test]
fn rejected_reload_stays_in_line_until_next() {
    let mut scene = Scene::new(None);
    let frame = good_frame();
    scene.feed(0.0, |time| Record::frame(time, BusIndex(0), frame));
    scene.readiness.note_reload(Some("pack.toml:3: pack.cells = 0,\nmust be 1 to 1024".to_owned()));
    let line = scene.readiness.line_now(&scene.monitor, scene.began).expect("reported at once");
    assert!(line.ends_with("; reload rejected: pack.toml:3: pack.cells = 0, must be 1 to 1024"), "{line}");
    scene.readiness.note_reload(None);
    let line = scene.readiness.line_now(&scene.monitor, scene.began).expect("reported at once");
    assert!(!line.contains("reload"), "{line}");
}

#[test]
fn status_line_has_no_control_characters() {
    assert_eq!(one_line("a\nREADY=1\tb", 100), "a READY=1 b");
    let long = "\u{fc}".repeat(2000);
    let line = one_line(&long, 1000);
    assert!(line.len() <= 1000 && line.ends_with("..."), "{} bytes", line.len());
}
