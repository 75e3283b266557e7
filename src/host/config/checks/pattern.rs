//! Parses and matches signal name patterns such as `CellVoltages{m}.CellVoltage{n}`, where `{n}` is the cell's number
//! and `{m}` any number.

#[derive(Debug, Clone, PartialEq, Eq)]
enum PatternPiece {
    Text(String),
    /// `{n}`: the cell's number, leading zeros allowed.
    Cell,
    /// `{m}`: any number.
    Any,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Pattern(Vec<PatternPiece>);

impl Pattern {
    /// Parses a pattern. The error describes what a pattern must be.
    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        let mut pieces = Vec::new();
        let mut rest = text;
        while let Some((before, after)) = rest.split_once('{') {
            let Some((name, tail)) = after.split_once('}') else {
                return Err("must close { with }".to_owned());
            };
            pieces.push(PatternPiece::Text(before.to_owned()));
            pieces.push(match name {
                "n" => PatternPiece::Cell,
                "m" => PatternPiece::Any,
                _ => return Err("must use braces only for {n} (the cell's number) and {m} (any number)".to_owned()),
            });
            rest = tail;
        }
        pieces.push(PatternPiece::Text(rest.to_owned()));
        Ok(Self(pieces))
    }

    /// Whether the pattern contains the cell's number.
    pub(crate) fn has_cell(&self) -> bool {
        self.0.contains(&PatternPiece::Cell)
    }

    /// Returns the cell's number if `name` matches the pattern. `Some(None)` = the name matches, but the pattern has no
    /// cell number.
    pub(crate) fn fits(&self, name: &str) -> Option<Option<u32>> {
        fits(&self.0, name, None)
    }
}

fn fits(pieces: &[PatternPiece], name: &str, cell: Option<u32>) -> Option<Option<u32>> {
    let Some((piece, pieces)) = pieces.split_first() else {
        return name.is_empty().then_some(cell);
    };
    if let PatternPiece::Text(text) = piece {
        return fits(pieces, name.strip_prefix(text.as_str())?, cell);
    }
    let digits = name.bytes().take_while(u8::is_ascii_digit).count();
    (1..=digits).rev().find_map(|end| {
        let (number, rest) = name.split_at(end);
        match (piece, number.parse::<u32>().ok()) {
            (PatternPiece::Cell, None) => None,
            (PatternPiece::Cell, number) if cell.is_some() && cell != number => None,
            (PatternPiece::Cell, number) => fits(pieces, rest, number),
            (PatternPiece::Any | PatternPiece::Text(_), _) => fits(pieces, rest, cell),
        }
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;

    fn fit(pattern: &str, name: &str) -> Option<Option<u32>> {
        Pattern::parse(pattern).unwrap().fits(name)
    }

    #[test]
    fn cell_number_comes_from_matching_name() {
        assert_eq!(fit("Cells.CellVoltage{n}", "Cells.CellVoltage12"), Some(Some(12)));
        assert_eq!(fit("Cells.CellVoltage{n}", "Cells.CellVoltage012"), Some(Some(12)));
        assert_eq!(fit("Cells{m}.V{n}_mV", "Cells3.V7_mV"), Some(Some(7)));
        assert_eq!(fit("Cells.V{n}{m}", "Cells.V123"), Some(Some(12)), "{{n}} takes as much as it can");
        assert_eq!(fit("C{n}.V{n}", "C4.V4"), Some(Some(4)));
        assert_eq!(fit("A.B", "A.B"), Some(None));
    }

    #[test]
    fn other_names_do_not_match() {
        for name in ["Cells.CellVoltage", "Cells.CellVoltage1Max", "Cells.Voltage1", "", "Cells.CellVoltage-1"] {
            assert_eq!(fit("Cells.CellVoltage{n}", name), None, "{name}");
        }
        assert_eq!(fit("C{n}.V{n}", "C4.V5"), None);
        assert_eq!(fit("V{n}", "V99999999999"), None, "more than any cell's number");
    }

    #[test]
    fn unknown_braces_are_rejected() {
        for text in ["A.B{", "A.B{x}", "A.{n}{"] {
            assert!(Pattern::parse(text).is_err(), "{text}");
        }
    }
}
