//! Formats text for people and for their terminals.

/// Escapes the control characters of a text. A name from a file or from another program could otherwise control the
/// terminal. Line ends and tabs are kept.
pub fn printable(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        if c.is_control() && !matches!(c, '\n' | '\t') {
            // The escape has the same form as in JSON and TOML.
            safe.extend(format!("\\u{:04x}", u32::from(c)).chars());
        } else {
            safe.push(c);
        }
    }
    safe
}

/// Formats columns as wide as their widest entry. The first `left` columns are left-aligned, the others right-aligned.
pub fn text_table<H: AsRef<str>>(heads: &[H], rows: impl IntoIterator<Item = Vec<String>>, left: usize) -> String {
    let heads: Vec<String> = heads.iter().map(|head| head.as_ref().to_owned()).collect();
    let rows: Vec<Vec<String>> = Some(heads).filter(|heads| !heads.is_empty()).into_iter().chain(rows).collect();
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let entry = |row: &[String], column: usize| {
        row.get(column).map_or_else(String::new, |text| printable(text).replace(['\n', '\t'], " "))
    };
    let widths: Vec<usize> =
        (0..columns).map(|c| rows.iter().map(|row| entry(row, c).chars().count()).max().unwrap_or(0)).collect();
    let line = |row: &Vec<String>| {
        let cells = widths.iter().enumerate().map(|(column, &width)| {
            let text = entry(row, column);
            if column < left { format!("{text:<width$}") } else { format!("{text:>width$}") }
        });
        cells.collect::<Vec<_>>().join("  ").trim_end().to_owned() + "\n"
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_control_terminal_or_forge_rows() {
        let rows = vec![vec!["\u{1b}[31mred\nall is well".to_owned(), "\u{9b}2J".to_owned()]];
        let table = text_table(&["name", "value"], rows, 1);
        assert_eq!(table.lines().count(), 2, "{table}");
        assert!(table.chars().all(|c| !c.is_control() || c == '\n'), "{table:?}");
        assert!(table.contains("\\u001b[31mred all is well") && table.contains("\\u009b2J"), "{table}");
    }
}
