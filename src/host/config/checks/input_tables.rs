//! Checks interface names and signal names in the input tables, even in a table that has another fault.
//!
//! [`RawTables`] does not contain tables that have a fault. The names in these tables must be checked too, so that
//! every fault is reported at once. These checks therefore read the TOML document.

use std::collections::BTreeSet;

use toml::de::{DeTable, DeValue};

use super::signals::{self, Databases};
use crate::config::document::{Document, TablePlace};
use crate::config::schema::keys::{CurrentInput, Interface, SignalSource};
use crate::config::schema::{RawTables, SECTIONS};
use crate::config::schema::{Section as _, SectionInfo};

pub(crate) fn interfaces(document: &Document<'_>, raw: &RawTables) {
    if raw.broken {
        return;
    }
    let count = raw.count::<Interface>();
    let allowed = match raw.has_all_interfaces() {
        true => format!("must be {}", raw.interface_names()),
        false => format!("must be the name of one of {count} interfaces"),
    };
    if count > 1 && !raw.is_written::<CurrentInput>() {
        let text = format!("{}.interface is missing, {allowed}", CurrentInput::PATH);
        raw.note(raw.input.as_ref().map(|input| &input.place), &text);
    }
    for (place, table) in with_key("interface").flat_map(|info| tables(document, info)) {
        let is_fault = match table.get("interface").map(|value| value.get_ref().as_str()) {
            Some(Some(name)) => {
                raw.has_all_interfaces() && count > 0 && !raw.interfaces.iter().any(|interface| interface.name == name)
            }
            Some(None) => false, // not a string: reported when it was read
            None => count > 1,
        };
        if is_fault {
            place.fault("interface", &allowed);
        }
    }
}

pub(crate) fn signals(document: &Document<'_>, raw: &RawTables, databases: &Databases) {
    let read: BTreeSet<&str> = raw.places().map(|place| place.path.as_str()).collect();
    for (place, table) in with_key("signal").flat_map(|info| tables(document, info)) {
        let signal = table.get("signal").and_then(|value| value.get_ref().as_str());
        let Some(signal) = signal.filter(|name| !name.contains('{') && !read.contains(place.path.as_str())) else {
            continue;
        };
        let source =
            SignalSource { place: &place, signal, interface: None, scale: 1.0, offset: 0.0, not_available: &[] };
        signals::check_name(raw, databases, &source);
    }
}

/// The kinds of input table that may have the key `key`.
fn with_key(key: &str) -> impl Iterator<Item = &'static SectionInfo> {
    let has = move |info: &&SectionInfo| info.keys.is_some_and(|keys| keys.iter().any(|known| known.name == key));
    SECTIONS.iter().filter(|info| info.path.starts_with("input.")).filter(has)
}

/// The tables of a section in the document, with their positions.
fn tables<'d>(document: &'d Document<'d>, info: &SectionInfo) -> Vec<(TablePlace, &'d DeTable<'d>)> {
    let Some(value) = document.find(info.path) else { return Vec::new() };
    match value.get_ref() {
        DeValue::Table(table) => {
            vec![(document.place(info.path, document.line(&value.span()), table), table)]
        }
        DeValue::Array(items) => {
            let tables = (1..).zip(items.iter()).filter_map(|(number, item)| {
                let DeValue::Table(table) = item.get_ref() else { return None };
                let path = format!("{}[{number}]", info.path);
                Some((document.place(&path, document.line(&item.span()), table), table))
            });
            tables.collect()
        }
        _ => Vec::new(),
    }
}
