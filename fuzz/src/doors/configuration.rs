//! Fuzz entry points for configurations and cell models. If a configuration is accepted, a monitor must run with it and
//! must be able to restore its own stored state.

use packwatch::config::Config;
use packwatch::monitor::{Downtime, Monitor, Outputs, Snapshot};

use super::core::records;
use super::source::Source;
use super::world::{self, CELL, DBC, PACK};

const REFERENCE: &str = include_str!("../../../docs/src/reference/keys.md");

/// Returns all configuration keys with a numeric value, as pairs of table and key, from the reference page.
fn keys() -> &'static [(&'static str, &'static str)] {
    static KEYS: std::sync::OnceLock<Vec<(&str, &str)>> = std::sync::OnceLock::new();
    KEYS.get_or_init(|| {
        let (mut keys, mut table) = (Vec::new(), "");
        for line in REFERENCE.lines() {
            if let Some(name) = line.strip_prefix("## `[").and_then(|rest| rest.split(']').next()) {
                table = name.trim_start_matches('[');
            }
            let mut parts = line.split('|').map(str::trim);
            let (Some(""), Some(name), Some(value)) = (parts.next(), parts.next(), parts.next()) else { continue };
            if value.contains("number") && !table.is_empty() {
                keys.push((table, name.trim_matches('`')));
            }
        }
        keys
    })
}

/// Returns the base configuration with numbers of any size in one to six keys.
fn drawn(source: &mut Source<'_>) -> Vec<u8> {
    let mut text = PACK.to_owned();
    for _ in 0..=source.byte() % 6 {
        let (table, name) = keys()[usize::from(source.u16()) % keys().len()];
        let number = source.number();
        let number = if number.is_nan() {
            "nan".to_owned()
        } else if source.byte().is_multiple_of(2) {
            format!("{number:e}")
        } else {
            format!("{}", number.trunc())
        };
        let header = format!("[{table}]\n");
        match text.find(&header) {
            Some(at) => text.insert_str(at + header.len(), &format!("{name} = {number}\n")),
            None => text += &format!("{header}{name} = {number}\n"),
        }
    }
    text.into_bytes()
}

/// Loads arbitrary bytes, or a configuration with numbers of any size. If it is accepted, runs a monitor.
pub fn configuration(data: &[u8]) {
    let mut source = Source::new(data);
    let pack = if source.byte().is_multiple_of(4) { source.rest().to_vec() } else { drawn(&mut source) };
    if let Ok(config) = world::load(&pack, DBC, CELL.as_bytes()) {
        run_and_restore(&config);
    }
}

/// Loads arbitrary bytes as the cell model, or the example cell model with one to six changed numbers. If it is
/// accepted, runs a monitor.
pub fn cell_model(data: &[u8]) {
    let mut source = Source::new(data);
    let model = if source.byte().is_multiple_of(4) { source.rest().to_vec() } else { changed(&mut source) };
    if let Ok(config) = world::load(PACK.as_bytes(), DBC, &model) {
        run_and_restore(&config);
    }
}

fn changed(source: &mut Source<'_>) -> Vec<u8> {
    let mut text = CELL.to_owned();
    for _ in 0..=source.byte() % 6 {
        let starts: Vec<usize> = text
            .char_indices()
            .filter(|(at, character)| character.is_ascii_digit() && text[..*at].ends_with([' ', '[', ',', '=', '-']))
            .map(|(at, _)| at)
            .collect();
        let from = starts[usize::from(source.u16()) % starts.len()];
        let length =
            text[from..].find(|c: char| !(c.is_ascii_digit() || matches!(c, '.' | 'e' | '-' | '+' | '_'))).unwrap_or(1);
        let number = source.number();
        text.replace_range(from..from + length, &format!("{number:e}"));
    }
    text.into_bytes()
}

fn run_and_restore(config: &Config) {
    const DRIVE: &[u8] = &[7, 0xE8, 3, 0, 20, 6, 20, 7, 0x18, 0xFC, 6, 20];
    let mut monitor = Monitor::new(config.monitor.clone());
    let mut out = Outputs { want_estimates: true, ..Outputs::default() };
    for record in records(&mut Source::new(DRIVE)).iter().take(200) {
        out.clear();
        monitor.handle(record, &mut out);
    }
    let text = serde_json::to_string(&monitor.snapshot()).expect("a snapshot serialises to JSON");
    let snapshot: Snapshot = serde_json::from_str(&text).expect("its own snapshot reads back");
    let accepted = Monitor::new(config.monitor.clone()).restore(snapshot, Downtime::AsStamped);
    assert!(accepted.is_ok(), "the monitor rejects its own state: {accepted:?}");
}
