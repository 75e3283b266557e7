//! Generates the manual page packwatch.toml(5): the reference of all keys as roff, from the same declarations as the
//! Markdown page.

use std::fmt::Write as _;

use super::reference;
use crate::config::cell_model;
use crate::config::schema::{Key, SECTIONS, SectionInfo};

/// Returns the page as roff.
pub fn manual() -> String {
    let mut page = format!(
        ".TH PACKWATCH.TOML 5 \"\" \"packwatch {}\" \"packwatch\"\n\
         .SH NAME\npackwatch.toml \\- configuration file and cell model files of packwatch\n\
         .SH DESCRIPTION\n",
        env!("CARGO_PKG_VERSION")
    );
    page.push_str(&roff(
        "TOML. Unknown keys are rejected. Whole numbers may be written in hex (`0x7FF`). Everywhere in packwatch a \
         positive current is a discharge, and SOC is a fraction. `packwatch check FILE` checks a file and prints what \
         it means.",
    ));
    page.push_str(".SH CONFIGURATION\n");
    sections(&mut page, SECTIONS);
    page.push_str(".SH CELL MODEL\n");
    page.push_str(&roff("A separate file, named by `pack.cell_model`."));
    sections(&mut page, cell_model::SECTIONS);
    page.push_str(
        ".SH FILES\n.TP\n.I /etc/packwatch/packwatch.toml\nConfiguration of the service.\n\
         .TP\n.I /etc/packwatch/packwatch.toml.d/*.toml\nDrop\\-ins, merged in the order of their names.\n\
         .TP\n.I /etc/packwatch/NAME.toml\nConfiguration of the instance packwatch@NAME, with drop\\-ins in NAME.toml.d.\n\
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

fn head(key: &Key) -> String {
    let unit = if key.unit.is_empty() { String::new() } else { format!(" ({})", key.unit) };
    let default = match reference::default(key) {
        required if required == "required" => required,
        default => format!("default: {default}"),
    };
    format!("`{}`: {}{unit}; {default}", key.name, reference::value(key))
}

/// A paragraph on one line, with `code` in bold and all roff control characters escaped.
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
    fn page_has_every_table_and_key() {
        let page = manual();
        for info in SECTIONS.iter().chain(cell_model::SECTIONS) {
            assert!(page.contains(&format!(".SS {}", roff(&reference::heading(info)))), "{}", info.path);
            for key in info.keys.unwrap_or(&[]) {
                assert!(page.contains(&format!(".TP\n\\&\\fB{}\\fR: ", key.name)), "{}.{}", info.path, key.name);
            }
        }
    }

    #[test]
    fn roff_control_characters_are_escaped() {
        assert_eq!(roff(".TH `a-b`\n'c' \\"), "\\&.TH \\fBa\\-b\\fR \\(aqc\\(aq \\e\n");
        assert!(manual().lines().all(|line| line.starts_with("\\&") || line.starts_with('.') || line.is_ascii()));
    }
}
