//! Statistics of a message that has the same identifier as the message with the pack current, but arrives on another
//! interface.
//!
//! Buses of one vehicle may use the same identifier for different messages, or carry the messages of several packs.
//! If the voltages follow the current in the message on the other interface, the configured interface is wrong.

use super::evidence::Series;
use super::evidence::Slope;
use super::evidence::response::{BLOCKS_S, VoltageResponse, best_response};
use crate::can::decode::Binding;
use crate::can::signal::SignalLayout;
use crate::quantity::Timestamp;

#[derive(Debug)]
pub(crate) struct OtherCurrent {
    pub(crate) series: Series,
    responses: [VoltageResponse; 2],
}

impl OtherCurrent {
    pub(crate) fn new(layout: &SignalLayout, cells: usize, tolerance_a: f64) -> Self {
        let responses = BLOCKS_S.map(|block_s| VoltageResponse::new(cells, tolerance_a, block_s));
        Self { series: Series::new(layout, None), responses }
    }

    pub(crate) fn handle(&mut self, time: Timestamp, payload: &[u8], binding: &Binding) {
        let Some(current_a) = self.series.handle(time, payload, binding, f64::INFINITY) else { return };
        self.responses.iter_mut().for_each(|response| response.handle_current(time, current_a));
    }

    pub(crate) fn responses_mut(&mut self) -> &mut [VoltageResponse; 2] {
        &mut self.responses
    }

    /// Slope of the median cell's voltage against this current.
    pub(crate) fn slope(&self) -> Option<Slope> {
        best_response(&self.responses).slope()
    }

    pub(crate) fn pause(&mut self) {
        self.series.pause();
        self.responses.iter_mut().for_each(VoltageResponse::pause);
    }
}
