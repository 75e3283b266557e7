//! Statistics of a current that is not on the configured interface. Its message has the same identifier as the message
//! of the configured current but arrives on another interface.
//!
//! Buses of one vehicle may use the same identifier for different messages, or carry the messages of several packs.
//! If the voltages follow the current in the message on the other interface, the configured interface is wrong.

use super::evidence::Series;
use super::evidence::Slope;
use super::evidence::response::{BLOCKS_S, VoltageResponse, best_response};
use crate::can::decode::Binding;
use crate::can::signal::SignalLayout;
use crate::quantity::Timestamp;

/// Statistics of the message on one other interface.
#[derive(Debug)]
pub(crate) struct OtherCurrent {
    pub(crate) series: Series,
    responses: [VoltageResponse; 2],
}

impl OtherCurrent {
    /// Creates empty statistics for `cells` voltages. A current change of at most `tolerance_a` (A), does not count as
    /// a change of load.
    pub(crate) fn new(layout: &SignalLayout, cells: usize, tolerance_a: f64) -> Self {
        let responses = BLOCKS_S.map(|block_s| VoltageResponse::new(cells, tolerance_a, block_s));
        Self { series: Series::new(layout, None), responses }
    }

    pub(crate) fn handle(&mut self, time: Timestamp, payload: &[u8], binding: &Binding) {
        let Some(current_a) = self.series.handle(time, payload, binding, f64::INFINITY) else { return };
        self.responses.iter_mut().for_each(|response| response.handle_current(time, current_a));
    }

    /// Voltage responses over short and long blocks.
    pub(crate) fn responses_mut(&mut self) -> &mut [VoltageResponse; 2] {
        &mut self.responses
    }

    /// Slope of the median cell's voltage against this current.
    pub(crate) fn slope(&self) -> Option<Slope> {
        best_response(&self.responses).slope()
    }

    /// Closes the open blocks of readings and the open runs of steady current. The observer calls this function at each
    /// gap in the observation, and at the end of the observation.
    pub(crate) fn pause(&mut self) {
        self.series.pause();
        self.responses.iter_mut().for_each(VoltageResponse::pause);
    }
}
