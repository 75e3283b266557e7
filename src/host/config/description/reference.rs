//! Generates the reference page of all keys from the same declarations as the fault messages.

use std::fmt::Write as _;

use crate::config::cell_model;
use crate::config::schema::{Key, Presence, SECTIONS, SectionInfo};

/// Returns the page as Markdown. `docs/src/reference/keys.md` has exactly this text.
pub fn reference() -> String {
    let mut page = String::from(
        "# Configuration keys\n\n\
         Printed by `packwatch check --reference`; do not edit. Unknown keys are rejected. Whole numbers may be written\n\
         in hex (`0x7FF`). Everywhere in packwatch a positive current is a discharge, and SOC is a fraction.\n\n\
         The column \"default\" shows the default as code, or describes it in words; keys marked \"required\" have none.\n\n\
         # Configuration file\n",
    );
    sections(&mut page, SECTIONS);
    page.push_str("\n# Cell model file\n\nA separate file, named by `pack.cell_model`.\n");
    sections(&mut page, cell_model::SECTIONS);
    page
}

fn sections(page: &mut String, sections: &[SectionInfo]) {
    for info in sections {
        let heading = heading(info);
        // Writing to a String cannot fail.
        let _ = write!(page, "\n## {heading}\n\n{}\n", info.about.trim());
        if let Some(keys) = info.keys {
            page.push_str("\n| key | value | unit | default | meaning |\n| --- | --- | --- | --- | --- |\n");
            for key in keys {
                page.push_str(&row(key));
            }
        }
    }
}

fn row(key: &Key) -> String {
    let (value, default) = (value(key), default(key));
    format!("| `{}` | {value} | {} | {default} | {} |\n", key.name, key.unit, key.about.trim())
}

/// The allowed values of a key in words.
pub(crate) fn value(key: &Key) -> String {
    match (key.choices.is_empty(), key.range()) {
        (false, choices) => choices.replace(" | ", ", "),
        (true, range) if range.is_empty() => key.kind.to_owned(),
        (true, range) => format!("{}, {range}", key.kind),
    }
}

/// The default as code or in words; `required` for required keys.
pub(crate) fn default(key: &Key) -> String {
    match key.presence {
        Presence::Required => "required".to_owned(),
        Presence::Optional(default) => default.to_owned(),
        Presence::Default(value) => format!("`{value}`"),
    }
}

/// The table's name as written in a file.
pub(crate) fn heading(info: &SectionInfo) -> String {
    match (info.path, info.many) {
        ("", _) => "Top of the file".to_owned(),
        (path, true) => format!("`[[{path}]]` (repeatable)"),
        (path, false) => format!("`[{path}]`"),
    }
}
