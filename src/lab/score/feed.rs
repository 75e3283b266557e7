//! Feeds the rows of a measured file to the monitor as frames on a bus. Between the rows, the replay driver sends the
//! monitor ticks (inputs that report the passing of time).

use crate::can::decode::SensorIndex;
use crate::filter::ScalarGaussian;
use crate::monitor::{Downtime, ModelState, MonitorConfig, Outputs, Snapshot};
use crate::quantity::{CellIndex, Channel, Timestamp};
use crate::replay::MonitorDriver;

/// A measured file can have several parts. If the start time of a part is unknown, the part is assumed to start this
/// long after the latest row (ns).
pub(super) const UNKNOWN_GAP_NS: i64 = 1_000_000_000;

/// Learned state of a monitor.
#[derive(Debug, Clone)]
pub struct Learned {
    /// Complete state of the monitor.
    pub snapshot: Snapshot,
    /// How well the cell's model is known.
    pub model: ModelState,
    /// Capacity (Ah).
    pub capacity: ScalarGaussian,
}

pub(super) struct Feeder(MonitorDriver);

impl Feeder {
    /// Creates a monitor. If `learned` is given, the monitor starts from that state.
    pub(super) fn new(config: MonitorConfig, sleep_gap_s: f64, learned: Option<&Learned>) -> Self {
        let mut driver = MonitorDriver::new(config, sleep_gap_s);
        if let Some(learned) = learned {
            // The state comes from the same configuration, except for the initial values, so it can be restored.
            let restored = driver.monitor.restore(learned.snapshot.clone(), Downtime::Unknown);
            debug_assert!(restored.is_ok(), "{restored:?}");
        }
        Self(driver)
    }

    pub(super) fn out(&mut self) -> &mut Outputs {
        &mut self.0.out
    }

    pub(super) fn uncarried(&self) -> usize {
        self.0.uncarried_values
    }

    pub(super) fn learned(&self) -> Learned {
        let monitor = &self.0.monitor;
        let capacity = monitor.capacity(CellIndex(0));
        Learned { snapshot: monitor.snapshot(), model: monitor.model().state, capacity }
    }

    /// Feeds one row: current (A, positive = discharge), voltage (V) and temperature (degrees Celsius); NaN = no value.
    pub(super) fn row(&mut self, time: Timestamp, current_a: f64, voltage_v: f64, temperature_c: f64) {
        let values = [
            (Channel::Current, Some(current_a)),
            (Channel::CellVoltage(CellIndex(0)), Some(voltage_v)),
            (Channel::Temperature(SensorIndex(0)), Some(temperature_c)),
        ];
        self.0.handle_row(time, &values);
    }

    /// Continues at `time`, after a gap of unknown length.
    pub(super) fn unknown_gap(&mut self, time: Timestamp) {
        self.0.handle_unknown_gap(time);
    }
}
