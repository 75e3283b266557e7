//! Encodes channel values as input frames, for CSV replay and the simulator.
//!
//! In: rows; a row lists channels with their values at one moment. Out: frames. Each message or multiplexer page with
//! at least one value gives one frame. A missing value is encoded as the signal's "not available" code, or as a code
//! that the receiver rejects (NaN, out of range). If neither exists, the frame is omitted and its values count as not
//! carried. A channel without a value causes a frame only if its signal has a "not available" code. Values beyond the
//! signal's bits saturate. Values outside the DBC's range stay outside, so that the receiver detects the fault. A
//! diagnostic response is encoded with its request and flow control.
//!
//! The rows of a log usually have the same channels in the same order. Therefore, the position of each signal's value
//! is stored until the channels change.

use std::cell::RefCell;
use std::collections::BTreeMap;

use crate::can::decode::{Binding, Channel, InputMap};
use crate::can::isotp::{FLOW_CONTROL, segment};
use crate::can::signal::{SignalPlan, ValueType};
use crate::can::uds::{Answer, AnswerSignal, Controller, Question};
use crate::can::{CanId, Frame, MAX_DATA};
use crate::quantity::BusIndex;

/// Largest code that is tried as a direction of the current. Direction signals have at most two bytes.
const MAX_DIRECTION_CODE: u64 = 0xFFFF;

/// Encodes values as input frames.
#[derive(Debug, Clone)]
pub struct InputEncoder {
    pages: Vec<InputPage>,
    answers: Vec<AnswerPage>,
    places: RefCell<RowPlaces>,
}

#[derive(Debug, Clone, Default)]
struct RowPlaces {
    channels: Vec<RowChannel>,
    /// Indexed by the field's number; `None` = the row does not have the channel.
    of_fields: Vec<Option<usize>>,
}

#[derive(Clone, Copy)]
struct PlacedRow<'a> {
    values: &'a [(Channel, Option<f64>)],
    of_fields: &'a [Option<usize>],
}

#[derive(Debug, Clone, Copy)]
struct RowChannel {
    channel: Channel,
    /// Whether the channel occurs again later in the row. The last value counts.
    is_overridden: bool,
    /// Whether a frame carries the channel's value.
    is_carried: bool,
}

#[derive(Debug, Clone)]
struct AnswerPage {
    question: Question,
    /// The response message with all signals 0.
    template: Vec<u8>,
    /// Signals, each with the byte at which its layout starts.
    fields: Vec<(usize, InputField)>,
}

/// A message or a multiplexer page.
#[derive(Debug, Clone)]
struct InputPage {
    bus: BusIndex,
    id: CanId,
    len: usize,
    /// Payload with the selectors; all other bits are 0.
    template: [u8; MAX_DATA],
    fields: Vec<InputField>,
}

#[derive(Debug, Clone)]
struct InputField {
    channel: Channel,
    /// Index for [`RowPlaces`].
    number: usize,
    plan: SignalPlan,
    scale: f64,
    offset: f64,
    /// Code for a missing value.
    missing: Option<u64>,
    /// Codes for charging and discharging, if the field is the direction of the current.
    direction: Option<[u64; 2]>,
    /// Whether another field carries the direction of the current.
    is_magnitude: bool,
    /// Whether `missing` is a configured "not available" code.
    has_not_available: bool,
}

impl InputField {
    fn new(binding: &Binding) -> Self {
        let not_available = binding.not_available.first().copied();
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
            channel: match binding.channel {
                Channel::CurrentDirection => Channel::Current,
                other => other,
            },
            direction: direction_codes(binding),
            is_magnitude: false,
            number: 0,
            plan: binding.plan,
            scale: binding.scale,
            offset: binding.offset,
            missing: not_available.or_else(|| candidates.into_iter().find(refused)),
            has_not_available: not_available.is_some(),
        }
    }

    fn place(&self, of_fields: &[Option<usize>]) -> Option<usize> {
        of_fields.get(self.number).copied().flatten()
    }

    /// NaN counts as missing.
    fn value(&self, row: PlacedRow<'_>) -> Option<f64> {
        row.values.get(self.place(row.of_fields)?)?.1.filter(|value| !value.is_nan())
    }

    fn is_sent(&self, row: PlacedRow<'_>) -> bool {
        self.place(row.of_fields).is_some() && (self.has_not_available || self.value(row).is_some())
    }

    fn code(&self, value: Option<f64>) -> Option<u64> {
        if let Some([charge, discharge]) = self.direction {
            return Some(if value.is_some_and(|current_a| current_a < 0.0) { charge } else { discharge });
        }
        let value = value.map(|value| if self.is_magnitude { value.abs() } else { value });
        let value = value.and_then(|value| self.plan.code_beyond_range((value - self.offset) / self.scale));
        value.or(self.missing)
    }
}

/// Codes for charging and discharging; `None` = the signal is not a direction or lacks a code.
fn direction_codes(binding: &Binding) -> Option<[u64; 2]> {
    let code = |direction: f64| {
        (0..=binding.plan.all_ones().min(MAX_DIRECTION_CODE)).find(|code| {
            let mut payload = [0; MAX_DATA];
            binding.plan.encode_raw(&mut payload, *code).is_ok() && binding.value(&payload) == Ok(direction)
        })
    };
    if binding.charge.is_empty() { None } else { Some([code(-1.0)?, code(1.0)?]) }
}

impl InputEncoder {
    /// Creates an encoder with one page per message and combination of selector codes.
    pub fn new(map: &InputMap) -> Self {
        let same_message = |a: &Binding, b: &Binding| (a.bus, a.id) == (b.bus, b.id);
        let pages = map.bindings().chunk_by(same_message).flat_map(|message| {
            // Signals that are always present are encoded on every page.
            let paged = message.iter().any(|binding| !binding.mux.is_empty());
            let of_a_page = message.iter().filter(|binding| !paged || !binding.mux.is_empty());
            let mut templates: Vec<_> = of_a_page.map(template).collect();
            templates.sort_unstable();
            templates.dedup();
            templates.into_iter().map(|template| InputPage::new(message, template))
        });
        Self { pages: pages.collect(), answers: Vec::new(), places: RefCell::default() }.numbered()
    }

    /// Adds diagnostic responses.
    #[must_use]
    pub fn with_answers(self, answers: &[Answer]) -> Self {
        Self { answers: answers.iter().map(AnswerPage::new).collect(), ..self }.numbered()
    }

    /// Appends the frames that carry `values` to `out`. `None` and NaN mean "no value". Returns the number of values
    /// that no frame carries.
    pub fn encode(&self, values: &[(Channel, Option<f64>)], out: &mut Vec<(BusIndex, Frame)>) -> usize {
        let mut places = self.places.borrow_mut();
        if !places.are_of(values) {
            *places = self.find_places(values);
        }
        let RowPlaces { channels, of_fields } = &mut *places;
        channels.iter_mut().for_each(|of| of.is_carried = false);
        let row = PlacedRow { values, of_fields };
        let mut carry = |field: &InputField| {
            let of = field.place(row.of_fields).and_then(|place| channels.get_mut(place));
            of.into_iter().for_each(|of| of.is_carried = true);
        };
        for page in &self.pages {
            if let Some(frame) = page.frame(row) {
                page.fields.iter().for_each(&mut carry);
                out.push((page.bus, frame));
            }
        }
        for answer in &self.answers {
            if let Some(message) = answer.message(row) {
                answer.fields.iter().for_each(|(_, field)| carry(field));
                answer.exchange(&message, out);
            }
        }
        let is_open = |of: &RowChannel| !of.is_carried && !of.is_overridden;
        let is_known = |value: Option<f64>| value.is_some_and(|value| !value.is_nan());
        channels.iter().zip(values).filter(|(of, (_, value))| is_open(of) && is_known(*value)).count()
    }

    fn numbered(mut self) -> Self {
        // The direction is sent before the magnitude, even in another message.
        self.pages.sort_by_key(|page| !page.fields.iter().any(|field| field.direction.is_some()));
        let of_pages = self.pages.iter_mut().flat_map(|page| &mut page.fields);
        let of_answers = self.answers.iter_mut().flat_map(|answer| &mut answer.fields).map(|(_, field)| field);
        let mut fields: Vec<_> = of_pages.chain(of_answers).collect();
        let has_direction = fields.iter().any(|field| field.direction.is_some());
        for (number, field) in fields.iter_mut().enumerate() {
            field.number = number;
            field.is_magnitude = has_direction && field.channel == Channel::Current && field.direction.is_none();
        }
        self.places = RefCell::default();
        self
    }

    fn find_places(&self, values: &[(Channel, Option<f64>)]) -> RowPlaces {
        let last: BTreeMap<Channel, usize> = values.iter().enumerate().map(|(place, value)| (value.0, place)).collect();
        let of_pages = self.pages.iter().flat_map(|page| &page.fields);
        let of_answers = self.answers.iter().flat_map(|answer| &answer.fields).map(|(_, field)| field);
        let channel = |(place, &(channel, _)): (usize, &(Channel, _))| RowChannel {
            channel,
            is_overridden: last.get(&channel) != Some(&place),
            is_carried: false,
        };
        RowPlaces {
            channels: values.iter().enumerate().map(channel).collect(),
            of_fields: of_pages.chain(of_answers).map(|field| last.get(&field.channel).copied()).collect(),
        }
    }
}

impl RowPlaces {
    fn are_of(&self, values: &[(Channel, Option<f64>)]) -> bool {
        // Before the first row, there are no positions.
        let is_found = !self.of_fields.is_empty() && self.channels.len() == values.len();
        is_found && self.channels.iter().zip(values).all(|(of, (channel, _))| of.channel == *channel)
    }
}

impl AnswerPage {
    fn new(answer: &Answer) -> Self {
        let mut template = answer.question.answer_head();
        let head = template.len();
        let ends = answer.signals.iter().map(|signal| signal.first_byte + signal.binding.plan.bytes_needed());
        template.resize(head + ends.max().unwrap_or(0), 0);
        let field = |signal: &AnswerSignal| (head + signal.first_byte, InputField::new(&signal.binding));
        Self { question: answer.question, template, fields: answer.signals.iter().map(field).collect() }
    }

    /// The response; `None` = it carries none of the values, or a missing value has no code.
    fn message(&self, row: PlacedRow<'_>) -> Option<Vec<u8>> {
        if !self.fields.iter().any(|(_, field)| field.is_sent(row)) {
            return None;
        }
        let mut message = self.template.clone();
        for (first_byte, field) in &self.fields {
            let code = field.code(field.value(row))?;
            field.plan.encode_raw(message.get_mut(*first_byte..)?, code).ok()?;
        }
        Some(message)
    }

    /// Appends request, response and flow control.
    fn exchange(&self, message: &[u8], out: &mut Vec<(BusIndex, Frame)>) {
        let Controller { bus, request, request_extension, response, response_extension } = self.question.controller;
        let of_tester = |payload: &[u8]| Frame::classic(request, payload).map(|frame| (bus, frame));
        out.extend(segment(request_extension, &self.question.request(), 0).first().and_then(|it| of_tester(it)));
        let frames = segment(response_extension, message, 0);
        for (index, payload) in frames.iter().enumerate() {
            out.extend(Frame::classic(response, payload).map(|frame| (bus, frame)));
            if index == 0 && frames.len() > 1 {
                let flow_control: Vec<u8> = request_extension.into_iter().chain(FLOW_CONTROL).collect();
                out.extend(of_tester(&flow_control));
            }
        }
    }
}

impl InputPage {
    /// Creates the page with every signal that is present with these selectors.
    fn new(message: &[Binding], template: [u8; MAX_DATA]) -> Self {
        let (bus, id) = (message[0].bus, message[0].id);
        let present: Vec<_> = message.iter().filter(|binding| binding.holds(&template) == Ok(true)).collect();
        let needed = |binding: &&Binding| {
            let plans = binding.mux.iter().map(|test| &test.plan).chain([&binding.plan]);
            plans.map(SignalPlan::bytes_needed).fold(usize::from(binding.len_bytes), usize::max)
        };
        let len = present.iter().map(needed).max().unwrap_or(0).min(MAX_DATA);
        Self { bus, id, len, template, fields: present.into_iter().map(InputField::new).collect() }
    }

    fn frame(&self, row: PlacedRow<'_>) -> Option<Frame> {
        if !self.fields.iter().any(|field| field.is_sent(row)) {
            return None;
        }
        let mut payload = self.template;
        for field in &self.fields {
            let code = field.code(field.value(row))?;
            field.plan.encode_raw(&mut payload, code).ok()?;
        }
        Frame::padded(self.id, self.len, &payload)
    }
}

/// Payload with the selectors of the binding's page. Each selector has the first code of its first range.
fn template(binding: &Binding) -> [u8; MAX_DATA] {
    let mut payload = [0; MAX_DATA];
    for test in &binding.mux {
        let code = test.ranges.first().map_or(0, |range| range.0);
        // A code that does not fit the selector cannot occur on the bus.
        let _ = test.plan.encode_raw(&mut payload, code);
    }
    payload
}

#[cfg(test)]
mod tests;
