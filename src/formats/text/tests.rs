//! Tests of all text formats: forms of lines, the same frames in every format, damaged logs, recognition.

use std::io::Cursor;

use packwatch_core::can::FrameKind;

use crate::{Channel, Format, Item, Source};

mod damage;
mod forms;
mod same;

fn read_as(format: Format, text: &[u8]) -> (Vec<Item>, Vec<Channel>) {
    let source = Source { reader: Box::new(Cursor::new(text.to_vec())), file: None };
    let mut log = format.open(source).expect("opens");
    let mut items = Vec::new();
    while let Some(item) = log.next_item().expect("memory reads") {
        items.push(item);
    }
    (items, log.channels().to_vec())
}

fn read(text: &[u8]) -> (Vec<Item>, Vec<Channel>) {
    read_as(Format::recognise(text).expect("recognised"), text)
}

/// Formats an item as time, channel, identifier and data: `1.5 0 100 05 00`. R (remote), F (FD), B (BRS) and E (ESI)
/// follow the identifier. Extended identifiers have 8 digits.
fn shown(item: &Item, channels: &[Channel]) -> String {
    let number = |channel: &u8| match &channels[usize::from(*channel)] {
        Channel::Name(name) => name.clone(),
        Channel::Number { index, .. } => index.to_string(),
    };
    match item {
        Item::Frame { time, channel, frame } => {
            let kind = match frame.kind() {
                FrameKind::Classic => String::new(),
                FrameKind::Remote => format!(" R{}", frame.len()),
                FrameKind::Fd { brs, esi } => format!(" F{}{}", if brs { "B" } else { "" }, if esi { "E" } else { "" }),
            };
            let data: String = frame.data().iter().map(|byte| format!(" {byte:02X}")).collect();
            format!("{} {} {}{kind}{data}", seconds(time.nanos()), number(channel), frame.id())
        }
        Item::ErrorFrame { time, channel, class } => {
            format!("{} {} error {class:X}", seconds(time.nanos()), number(channel))
        }
        Item::Xl => "XL".to_owned(),
        Item::Other => "other".to_owned(),
        Item::Bad(message) => message.clone(),
    }
}

/// Decimal seconds without zeros at the end.
fn seconds(nanos: i64) -> String {
    let text = format!("{}.{:09}", nanos.div_euclid(1_000_000_000), nanos.rem_euclid(1_000_000_000));
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// The frames, error frames, XL frames and bad lines of a log.
fn content(text: &[u8]) -> Vec<String> {
    let (items, channels) = read(text);
    items.iter().filter(|item| **item != Item::Other).map(|item| shown(item, &channels)).collect()
}

/// Checks that a log contains these items.
fn check(text: &str, expected: &[&str]) {
    assert_eq!(content(text.as_bytes()), expected, "{text}");
}
