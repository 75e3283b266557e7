//! The manual page packwatch.toml(5): the reference of all keys as roff, from the same lines as the Markdown page.

use std::fmt::Write as _;

use super::reference;
use crate::config::cell_model;
use crate::config::schema::{Key, SECTIONS, SectionInfo};

/// The page, for `man`.
pub fn manual() -> String {
    let mut page = format!(
        ".TH PACKWATCH.TOML 5 \"\" \"packwatch {}\" \"packwatch\"\n\
         .SH NAME\npackwatch.toml \\- configuration of packwatch, and its cell models\n\
         .SH DESCRIPTION\n",
        env!("CARGO_PKG_VERSION")
    );
    page.push_str(&roff(
        "TOML. Unknown keys are refused. Whole numbers may be written in hex (`0x7FF`). Inside and in everything \
         reported, positive current is discharge and SOC is a fraction. `packwatch check FILE` says whether a file is \
         good, and what it means.",
    ));
    page.push_str(".SH CONFIGURATION\n");
    sections(&mut page, SECTIONS);
    page.push_str(".SH CELL MODEL\n");
    page.push_str(&roff("A file of its own, named by `pack.cell_model`."));
    sections(&mut page, cell_model::SECTIONS);
    page.push_str(
        ".SH FILES\n.TP\n.I /etc/packwatch/packwatch.toml\nWhat the service reads.\n\
         .TP\n.I /etc/packwatch/packwatch.toml.d/*.toml\nDrop\\-ins, merged into it in the order of their names.\n\
         .TP\n.I /etc/packwatch/NAME.toml\nWhat the instance packwatch@NAME reads, with NAME.toml.d.\n\
         .SH SEE ALSO\n.BR packwatch (1),\n.BR packwatch\\-check (1),\n.BR packwatch\\-run (1)\n",
    );
    page
}

fn sections(page: &mut String, sections: &[SectionInfo]) {
    for info in sections {
        // Writing to a String cannot fail.
        let _ = write!(page, ".SS {}{}", roff(&reference::heading(info)), roff(info.about.trim()));
        for key in info.keys.unwrap_or(&[]) {
            let _ = write!(page, ".TP\n{}{}", roff(&head(key)), roff(key.about.trim()));
        }
    }
}

/// Name, value, unit and what holds without it, in a line.
fn head(key: &Key) -> String {
    let unit = if key.unit.is_empty() { String::new() } else { format!(" ({})", key.unit) };
    let without = match reference::without(key) {
        without if without.starts_with('`') => format!("default {without}"),
        without => without,
    };
    format!("`{}`: {}{unit}; {without}", key.name, reference::value(key))
}

/// A paragraph with `code` in bold, on one line, with nothing in it that roff would take for its own.
fn roff(text: &str) -> String {
    let mut line = String::from("\\&");
    let mut code = false;
    for character in text.chars() {
        match character {
            '`' => {
                code = !code;
                line.push_str(if code { "\\fB" } else { "\\fR" });
            }
            '\\' => line.push_str("\\e"),
            '-' => line.push_str("\\-"),
            '\'' => line.push_str("\\(aq"),
            '^' => line.push_str("\\(ha"),
            '~' => line.push_str("\\(ti"),
            '\n' => line.push(' '),
            other => line.push(other),
        }
    }
    line.push('\n');
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_has_every_table_and_key() {
        let page = manual();
        for info in SECTIONS.iter().chain(cell_model::SECTIONS) {
            assert!(page.contains(&format!(".SS {}", roff(&reference::heading(info)))), "{}", info.path);
            for key in info.keys.unwrap_or(&[]) {
                assert!(page.contains(&format!(".TP\n\\&\\fB{}\\fR: ", key.name)), "{}.{}", info.path, key.name);
            }
        }
    }

    #[test]
    fn nothing_written_for_people_is_taken_for_a_request() {
        assert_eq!(roff(".TH `a-b`\n'c' \\"), "\\&.TH \\fBa\\-b\\fR \\(aqc\\(aq \\e\n");
        assert!(manual().lines().all(|line| line.starts_with("\\&") || line.starts_with('.') || line.is_ascii()));
    }
}
