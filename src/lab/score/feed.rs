//! Feeds rows of a measured file to the monitor: frames as a bus would carry them, and the driver's ticks between them.

use super::learn::Learned;
use crate::can::Frame;
use crate::can::decode::SensorIndex;
use crate::can::encode::{InputEncoder, InputProtector};
use crate::io::ticks::Ticks;
use crate::monitor::{Downtime, Input, Monitor, MonitorConfig, Outputs, TICK_PERIOD_MS};
use crate::quantity::{BusIndex, CellIndex, Channel, Timestamp};

/// A monitor with the encoder and ticks of a replay.
pub(super) struct Feeder {
    monitor: Monitor,
    encoder: InputEncoder,
    protector: InputProtector,
    ticks: Ticks,
    frames: Vec<(BusIndex, Frame)>,
    /// Outputs since the caller last cleared them.
    pub(super) out: Outputs,
    /// Values that no frame can carry.
    pub(super) uncarried: usize,
}

impl Feeder {
    /// A monitor before its first row, which continues from what it has learned.
    pub(super) fn new(config: MonitorConfig, sleep_gap_s: f64, learned: Option<&Learned>) -> Self {
        let mut feeder = Self {
            encoder: InputEncoder::new(&config.input).with_answers(&config.answers),
            protector: InputProtector::new(&config.guards),
            monitor: Monitor::new(config),
            ticks: Ticks::new(TICK_PERIOD_MS, sleep_gap_s),
            frames: Vec::new(),
            out: Outputs { want_estimates: true, ..Outputs::default() },
            uncarried: 0,
        };
        if let Some(learned) = learned {
            // It is of the same configuration.
            let restored = feeder.monitor.restore(learned.snapshot.clone(), Downtime::Unknown);
            debug_assert!(restored.is_ok(), "{restored:?}");
        }
        feeder
    }

    /// What the monitor has learned.
    pub(super) fn learned(&self) -> Learned {
        let monitor = &self.monitor;
        let capacity = monitor.capacity(CellIndex(0));
        Learned { snapshot: monitor.snapshot(), model: monitor.model().state, capacity }
    }

    /// Feeds one row: A (positive = discharge), V, degrees C; NaN = no value.
    pub(super) fn row(&mut self, time: Timestamp, current_a: f64, voltage_v: f64, temperature_c: f64) {
        self.ticks.advance(time);
        self.send_ticks();
        let values = [
            (Channel::Current, Some(current_a)),
            (Channel::CellVoltage(CellIndex(0)), Some(voltage_v)),
            (Channel::Temperature(SensorIndex(0)), Some(temperature_c)),
        ];
        let mut frames = std::mem::take(&mut self.frames);
        self.uncarried += self.encoder.encode(&values, &mut frames);
        self.protector.protect(&mut frames);
        for (bus, frame) in frames.drain(..) {
            self.monitor.handle(Input::Frame { time, bus, frame: &frame }, &mut self.out);
        }
        self.frames = frames;
    }

    /// The record continues at `time` after a gap of unknown length.
    pub(super) fn unknown_gap(&mut self, time: Timestamp) {
        self.ticks.sleep();
        self.send_ticks();
        self.monitor.handle(Input::UnknownGap { time }, &mut self.out);
    }

    fn send_ticks(&mut self) {
        while let Some(time) = self.ticks.pop(self.monitor.next_due()) {
            self.monitor.handle(Input::Tick { time }, &mut self.out);
        }
    }
}
