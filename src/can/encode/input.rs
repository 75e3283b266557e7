//! Input frames made from channel values: the way in of CSV replay and of the simulator.
//!
//! Each message and multiplexer page that has a value makes one frame. A signal of that frame without a value is
//! written as its "not available" code, or else as a code that its reader refuses (NaN, out of range); where
//! there is no such code the whole frame is left out and its values are counted as not carried. A frame without
//! any value is not sent, except to say "not available" to signals that have such a code. Values outside what the bits
//! can hold saturate; values outside the DBC's range stay outside, so that their reader sees the fault.

use std::collections::BTreeMap;

use super::frame_of;
use crate::can::decode::{Binding, Channel, InputMap};
use crate::can::signal::{SignalPlan, ValueType};
use crate::can::{CanId, Frame, MAX_DATA};
use crate::quantity::BusIndex;

/// Makes input frames from values.
#[derive(Debug, Clone)]
pub struct InputEncoder {
    pages: Vec<Page>,
}

/// One message, or one multiplexer page of it.
#[derive(Debug, Clone)]
struct Page {
    bus: BusIndex,
    id: CanId,
    len: usize,
    /// Selectors written, everything else 0.
    template: [u8; MAX_DATA],
    fields: Vec<Field>,
}

#[derive(Debug, Clone)]
struct Field {
    channel: Channel,
    plan: SignalPlan,
    scale: f64,
    offset: f64,
    /// Code for "no value".
    missing: Option<u64>,
    /// That code is a configured "not available", worth a frame of its own.
    told: bool,
}

impl Field {
    fn new(binding: &Binding) -> Self {
        let told = binding.not_available.first().copied();
        let length = binding.plan.length_bits();
        let lowest = 1_u64 << (length - 1);
        let candidates = match binding.plan.value_type() {
            ValueType::Float32 => [u64::from(f32::NAN.to_bits()), u64::from(f32::INFINITY.to_bits())],
            ValueType::Float64 => [f64::NAN.to_bits(), f64::INFINITY.to_bits()],
            ValueType::Unsigned => [binding.plan.all_ones(), 0],
            ValueType::Signed => [lowest, lowest - 1],
        };
        let refused = |code: &u64| {
            let mut payload = [0; MAX_DATA];
            binding.plan.encode_raw(&mut payload, *code).is_ok() && binding.value(&payload).is_err()
        };
        Self {
            channel: binding.channel,
            plan: binding.plan,
            scale: binding.scale,
            offset: binding.offset,
            missing: told.or_else(|| candidates.into_iter().find(refused)),
            told: told.is_some(),
        }
    }

    fn code(&self, value: Option<f64>) -> Option<u64> {
        let value = value.and_then(|value| self.plan.code_beyond_range((value - self.offset) / self.scale));
        value.or(self.missing)
    }
}

impl InputEncoder {
    /// Groups the map's signals by message and multiplexer page.
    pub fn new(map: &InputMap) -> Self {
        let mut pages: Vec<Page> = Vec::new();
        // Signals that are always there ride on every page of their message: they come last.
        let (paged, always): (Vec<_>, Vec<_>) = map.bindings().iter().partition(|binding| !binding.mux.is_empty());
        for binding in paged {
            let template = template(binding);
            let same = |page: &&mut Page| page.same_message(binding) && page.template == template;
            match pages.iter_mut().find(same) {
                Some(page) => page.fields.push(Field::new(binding)),
                None => pages.push(Page::new(binding, template)),
            }
        }
        for binding in always {
            let mut found = false;
            for page in pages.iter_mut().filter(|page| page.same_message(binding)) {
                page.fields.push(Field::new(binding));
                found = true;
            }
            if !found {
                pages.push(Page::new(binding, [0; MAX_DATA]));
            }
        }
        Self { pages }
    }

    /// Appends the frames that carry `values` to `out`; `None` and NaN mean "no value now". Returns how many
    /// values no frame could carry.
    pub fn encode(&self, values: &[(Channel, Option<f64>)], out: &mut Vec<(BusIndex, Frame)>) -> usize {
        let given: BTreeMap<Channel, Option<f64>> =
            values.iter().map(|(channel, value)| (*channel, value.filter(|value| !value.is_nan()))).collect();
        let mut open: Vec<Channel> =
            given.iter().filter(|(_, value)| value.is_some()).map(|(channel, _)| *channel).collect();
        for page in &self.pages {
            if let Some(frame) = page.frame(&given) {
                open.retain(|channel| !page.fields.iter().any(|field| field.channel == *channel));
                out.push((page.bus, frame));
            }
        }
        open.len()
    }
}

impl Page {
    fn new(binding: &Binding, template: [u8; MAX_DATA]) -> Self {
        let len = usize::from(binding.len_bytes).max(binding.plan.bytes_needed()).min(MAX_DATA);
        Self { bus: binding.bus, id: binding.id, len, template, fields: vec![Field::new(binding)] }
    }

    fn same_message(&self, binding: &Binding) -> bool {
        self.bus == binding.bus && self.id == binding.id
    }

    fn frame(&self, given: &BTreeMap<Channel, Option<f64>>) -> Option<Frame> {
        let worth = |field: &Field| match given.get(&field.channel) {
            Some(Some(_)) => true,
            Some(None) => field.told,
            None => false,
        };
        if !self.fields.iter().any(worth) {
            return None;
        }
        let mut payload = self.template;
        for field in &self.fields {
            let code = field.code(given.get(&field.channel).copied().flatten())?;
            field.plan.encode_raw(&mut payload, code).ok()?;
        }
        frame_of(self.id, self.len, &payload)
    }
}

/// A payload with the selectors of the binding's page written, each as the first code of its first range.
fn template(binding: &Binding) -> [u8; MAX_DATA] {
    let mut payload = [0; MAX_DATA];
    for test in &binding.mux {
        let code = test.ranges.first().map_or(0, |range| range.0);
        // A code the selector cannot hold leaves 0: no frame of that page can exist on a bus either.
        let _ = test.plan.encode_raw(&mut payload, code);
    }
    payload
}
