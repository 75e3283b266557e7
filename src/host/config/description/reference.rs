//! The reference page of all keys, from the same lines the faults come from.

use std::fmt::Write as _;

use crate::config::cell_model;
use crate::config::schema::{Key, Presence, SECTIONS, SectionInfo};

/// The page, as Markdown; `docs/src/reference/keys.md` is exactly this.
pub fn reference() -> String {
    let mut page = String::from(
        "# Reference of keys\n\n\
         Printed by `packwatch check --reference`; do not edit. Unknown keys are refused. Whole numbers may be\n\
         written in hex (`0x7FF`). Inside and in everything reported, positive current is discharge and SOC is a\n\
         fraction.\n\n# Configuration\n",
    );
    sections(&mut page, SECTIONS);
    page.push_str("\n# Cell model\n\nA file of its own, named by `pack.cell_model`.\n");
    sections(&mut page, cell_model::SECTIONS);
    page
}

fn sections(page: &mut String, sections: &[SectionInfo]) {
    for info in sections {
        let heading = heading(info);
        // Writing to a String cannot fail.
        let _ = write!(page, "\n## {heading}\n\n{}\n", info.about.trim());
        if let Some(keys) = info.keys {
            page.push_str("\n| key | value | unit | without it | meaning |\n| --- | --- | --- | --- | --- |\n");
            for key in keys {
                page.push_str(&row(key));
            }
        }
    }
}

fn row(key: &Key) -> String {
    let (value, without) = (value(key), without(key));
    format!("| `{}` | {value} | {} | {without} | {} |\n", key.name, key.unit, key.about.trim())
}

/// Allowed values.
pub(crate) fn value(key: &Key) -> String {
    match (key.choices.is_empty(), key.range()) {
        (false, choices) => choices.replace(" | ", ", "),
        (true, range) if range.is_empty() => key.kind.to_owned(),
        (true, range) => format!("{}, {range}", key.kind),
    }
}

/// Effect of leaving it out.
pub(crate) fn without(key: &Key) -> String {
    match key.presence {
        Presence::Required => "required".to_owned(),
        Presence::Optional => "see meaning".to_owned(),
        Presence::Default(value) => format!("`{value}`"),
    }
}

/// How a table is written.
pub(crate) fn heading(info: &SectionInfo) -> String {
    match (info.path, info.many) {
        ("", _) => "Top of the file".to_owned(),
        (path, true) => format!("`[[{path}]]`, any number of times"),
        (path, false) => format!("`[{path}]`"),
    }
}
