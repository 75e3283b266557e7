//! Sends log lines to journald as entries with fields, over its native protocol (systemd.io/JOURNAL_NATIVE_PROTOCOL).
//!
//! An entry has `MESSAGE`, `PRIORITY`, `SYSLOG_IDENTIFIER`, `TARGET`, its source location, and each field as
//! `PACKWATCH_NAME`. `MESSAGE` is the text with the fields as `name=value`, so that `systemctl status` shows them.
//! Messages that programs search for also have a `MESSAGE_ID`. Nothing here blocks, because the estimation loop also
//! logs. If journald stalls and does not accept an entry, the entry is dropped and counted.

use std::fmt::{self, Write as _};
use std::io::{self, ErrorKind};
use std::os::unix::net::UnixDatagram;

use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_subscriber::layer::{Context, Layer};

use super::note_left_out;

const SOCKET: &str = "/run/systemd/journal/socket";
/// Maximum length of a value, bytes. Longer values are cut, so that an entry with a few such values fits into a
/// datagram.
const MAX_VALUE: usize = 8 * 1024;
/// Permanent ids of messages that programs search for (`journalctl MESSAGE_ID=...`), by their text.
const MESSAGE_IDS: [(&str, &str); 3] = [
    ("alarm raised", "7a9c9a5d3bc5449eb08f6ca450cbf382"),
    ("alarm cleared", "15d731239a594556adf6d13cc7b79ac2"),
    ("configuration rejected, the old one stays", "870d888fffdd45d08f0fbc3c3a1489e9"),
];

#[derive(Debug)]
pub(super) struct Journal {
    socket: UnixDatagram,
}

impl Journal {
    /// Opens a socket and checks that journald listens.
    ///
    /// # Errors
    /// Fails if journald is not running, or its socket cannot be reached.
    pub(super) fn new() -> io::Result<Self> {
        let socket = UnixDatagram::unbound()?;
        socket.set_nonblocking(true)?;
        // journald ignores an empty datagram. If journald does not listen, sending fails. The error `WouldBlock` means
        // that journald listens and its queue is full.
        match socket.send_to(&[], SOCKET) {
            Err(error) if error.kind() != ErrorKind::WouldBlock => Err(error),
            Ok(_) | Err(_) => Ok(Self { socket }),
        }
    }
}

impl<S: Subscriber> Layer<S> for Journal {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        // The socket is not connected, because journald may be restarted.
        if self.socket.send_to(&entry(event), SOCKET).is_err() {
            note_left_out();
        }
    }
}

/// Formats an event for journald.
fn entry(event: &Event<'_>) -> Vec<u8> {
    let mut text = EventText::default();
    event.record(&mut text);
    let meta = event.metadata();
    let mut entry = Vec::with_capacity(512);
    put(&mut entry, "MESSAGE", &format!("{}{}", text.message, text.fields_text));
    put(&mut entry, "PRIORITY", priority(*meta.level()));
    put(&mut entry, "SYSLOG_IDENTIFIER", "packwatch");
    put(&mut entry, "TARGET", meta.target());
    if let (Some(file), Some(line)) = (meta.file(), meta.line()) {
        put(&mut entry, "CODE_FILE", file);
        put(&mut entry, "CODE_LINE", &line.to_string());
    }
    if let Some((_, id)) = MESSAGE_IDS.iter().find(|(message, _)| *message == text.message) {
        put(&mut entry, "MESSAGE_ID", id);
    }
    for (name, value) in &text.fields {
        put(&mut entry, &field_name(name), value);
    }
    entry
}

fn priority(level: Level) -> &'static str {
    match level {
        Level::ERROR => "3",
        Level::WARN => "4",
        Level::INFO => "6",
        Level::DEBUG | Level::TRACE => "7",
    }
}

/// Returns the journal's name of a field, such as `PACKWATCH_CELL` for `cell`. journald allows capital letters, digits
/// and underscores.
fn field_name(name: &str) -> String {
    let allowed = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' };
    format!("PACKWATCH_{}", name.chars().map(allowed).collect::<String>())
}

/// Appends one field; a value with line feeds is preceded by its length.
fn put(entry: &mut Vec<u8>, name: &str, value: &str) {
    let end = (0..=value.len().min(MAX_VALUE)).rev().find(|&end| value.is_char_boundary(end)).unwrap_or(0);
    let value = &value[..end];
    entry.extend_from_slice(name.as_bytes());
    if value.contains('\n') {
        entry.push(b'\n');
        entry.extend_from_slice(&(value.len() as u64).to_le_bytes());
    } else {
        entry.push(b'=');
    }
    entry.extend_from_slice(value.as_bytes());
    entry.push(b'\n');
}

#[derive(Debug, Default)]
struct EventText {
    message: String,
    /// The fields as ` name=value`.
    fields_text: String,
    fields: Vec<(&'static str, String)>,
}

impl EventText {
    fn take(&mut self, field: &Field, value: String) {
        if field.name() == "message" {
            self.message = value;
            return;
        }
        // Writing to a string cannot fail.
        let _ = write!(self.fields_text, " {}={value}", field.name());
        self.fields.push((field.name(), value));
    }
}

impl Visit for EventText {
    fn record_str(&mut self, field: &Field, value: &str) {
        self.take(field, value.to_owned());
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.take(field, format!("{value:?}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::{Arc, Mutex};
    use tracing_subscriber::layer::SubscriberExt;

    /// Captures entries as journald would receive them.
    #[derive(Clone, Default)]
    struct CapturedEntries(Arc<Mutex<Vec<Vec<u8>>>>);

    impl<S: Subscriber> Layer<S> for CapturedEntries {
        fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
            self.0.lock().expect("one thread").push(entry(event));
        }
    }

    fn entry_of(log: impl FnOnce()) -> String {
        let kept = CapturedEntries::default();
        tracing::subscriber::with_default(tracing_subscriber::registry().with(kept.clone()), log);
        let entries = kept.0.lock().expect("one thread");
        assert_eq!(entries.len(), 1);
        String::from_utf8_lossy(&entries[0]).into_owned()
    }

    #[test]
    fn alarm_entry_has_fields_priority_and_id() {
        let cell = Some(3_u32);
        let entry = entry_of(|| tracing::warn!(rule = ?"capacity_low", cell, value = 1.5, "{}", "alarm raised"));
        let has = |line: &str| assert!(entry.lines().any(|found| found == line), "no {line} in {entry}");
        has("MESSAGE=alarm raised rule=\"capacity_low\" cell=3 value=1.5");
        has("PRIORITY=4");
        has("SYSLOG_IDENTIFIER=packwatch");
        has("MESSAGE_ID=7a9c9a5d3bc5449eb08f6ca450cbf382");
        has("PACKWATCH_CELL=3");
        has("PACKWATCH_VALUE=1.5");
    }

    #[test]
    fn other_message_has_no_id() {
        let entry = entry_of(|| tracing::info!("alarm still raised, value unknown"));
        assert!(!entry.contains("MESSAGE_ID") && entry.contains("PRIORITY=6"), "{entry}");
    }

    #[test]
    fn value_with_line_feeds_cannot_inject_fields() {
        let entry = entry_of(|| tracing::error!(error = "a\nPRIORITY=0", "bad"));
        let wanted = "PACKWATCH_ERROR\n\u{c}\0\0\0\0\0\0\0a\nPRIORITY=0\n";
        assert!(entry.contains(wanted), "{entry:?}");
    }

    #[test]
    fn long_value_is_cut_between_characters() {
        let mut entry = Vec::new();
        put(&mut entry, "X", &"\u{20ac}".repeat(MAX_VALUE));
        assert!(entry.len() <= MAX_VALUE + 3 && String::from_utf8(entry).is_ok());
    }
}
