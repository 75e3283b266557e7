//! Drives a monitor with rows of values or with frames, and adds the periodic ticks between them, as a replay does.
//!
//! Rows are in A (positive = discharge), V and degrees C. The outputs are the monitor's [`Outputs`], which the caller
//! clears. Guarantee: `packwatch replay` with a log of the same inputs gives the same outputs.

use crate::can::Frame;
use crate::can::decode::Channel;
use crate::io::reading::RowFrames;
use crate::io::ticks::Ticks;
use crate::monitor::{Monitor, MonitorConfig, Outputs, Record, TICK_PERIOD_MS};
use crate::quantity::{BusIndex, Timestamp};

/// A monitor, its ticks, and the encoder that turns rows into frames.
#[derive(Debug)]
pub struct MonitorDriver {
    pub monitor: Monitor,
    row_frames: RowFrames,
    ticks: Ticks,
    frames: Vec<(BusIndex, Frame)>,
    /// Outputs since the caller last cleared this field.
    pub out: Outputs,
    /// Number of values that no frame can carry.
    pub uncarried_values: usize,
}

impl MonitorDriver {
    /// Creates a driver with a new monitor. A gap of more than `sleep_gap_s` (s) means that the recorder was asleep.
    pub fn new(config: MonitorConfig, sleep_gap_s: f64) -> Self {
        Self {
            row_frames: RowFrames::new(&config),
            monitor: Monitor::new(config),
            ticks: Ticks::new(TICK_PERIOD_MS, sleep_gap_s),
            frames: Vec::new(),
            out: Outputs { want_estimates: true, ..Outputs::default() },
            uncarried_values: 0,
        }
    }

    /// Handles one row. `None` and NaN mean that a value is missing.
    pub fn handle_row(&mut self, time: Timestamp, values: &[(Channel, Option<f64>)]) {
        self.advance(time);
        let mut frames = std::mem::take(&mut self.frames);
        self.uncarried_values += self.row_frames.encode(values, &mut frames);
        for (bus, frame) in frames.drain(..) {
            self.monitor.handle(&Record::frame(time, bus, &frame), &mut self.out);
        }
        self.frames = frames;
    }

    /// Handles one frame.
    pub fn handle_frame(&mut self, time: Timestamp, bus: BusIndex, frame: &Frame) {
        self.advance(time);
        self.monitor.handle(&Record::frame(time, bus, frame), &mut self.out);
    }

    /// Continues at `time` after a gap of unknown length.
    pub fn handle_unknown_gap(&mut self, time: Timestamp) {
        self.ticks.sleep();
        self.send_ticks();
        self.monitor.handle(&Record::unknown_gap(time), &mut self.out);
    }

    /// Ends the input, so that the last samples become estimates.
    pub fn finish(&mut self) {
        self.ticks.sleep();
        self.send_ticks();
        self.monitor.settle(&mut self.out);
    }

    fn advance(&mut self, time: Timestamp) {
        self.ticks.advance(time);
        self.send_ticks();
    }

    fn send_ticks(&mut self) {
        while let Some(time) = self.ticks.pop(self.monitor.next_due()) {
            self.monitor.handle(&Record::tick(time), &mut self.out);
        }
    }
}
