//! Splits the text of a DBC into statements and parses the usable statements.
//!
//! In: the text. Out: the syntax tree of the `can-dbc` crate, and a fault for each statement that was left out. A
//! message definition (`BO_`) and its signals form one statement. If the whole text does not parse, each statement is
//! parsed alone, so that the time stays proportional to the text's length. Left-out statements become empty lines, so
//! that line numbers do not change.

use std::collections::HashSet;

use super::DbcError;

/// Maximum number of characters that an error message quotes from the file.
const MAX_QUOTE: usize = 80;

struct Statement<'t> {
    /// Line of the first character, from 1.
    line: usize,
    text: &'t str,
}

/// Parses the usable statements and adds a fault to `left_out` for every other statement. The returned flag is false if
/// a statement was left out because it does not follow the grammar. Statements that were left out because of an invalid
/// identifier do not change the flag. If the usable statements together are not a valid DBC, returns the first fault of
/// the whole text.
pub(super) fn parse(text: &str, left_out: &mut Vec<DbcError>) -> Result<(can_dbc::Dbc, bool), DbcError> {
    let mut statements = split(text);
    leave_out_bad_identifiers(&mut statements, left_out);
    let all = join(text, &statements);
    can_dbc::Dbc::try_from(all.as_str()).map(|dbc| (dbc, true)).or_else(|error| {
        let whole = grammar_fault(&error);
        statements.retain(|statement| match can_dbc::Dbc::try_from(statement.text) {
            Ok(_) => true,
            Err(error) => {
                let fault = grammar_fault(&error);
                left_out.push(statement.fault(statement.line + fault.line - 1, &fault.what));
                false
            }
        });
        can_dbc::Dbc::try_from(join(text, &statements).as_str()).map(|dbc| (dbc, false)).map_err(|_| whole)
    })
}

/// Splits the text before each line that begins with a keyword, such as `BO_`.
fn split(text: &str) -> Vec<Statement<'_>> {
    let mut statements = Vec::new();
    let (mut start, mut start_line, mut end) = (0, 1, 0);
    for (line, content) in (1..).zip(text.split_inclusive('\n')) {
        if starts_statement(content) && end > start {
            statements.push(Statement { line: start_line, text: &text[start..end] });
            (start, start_line) = (end, line);
        }
        end += content.len();
    }
    statements.push(Statement { line: start_line, text: &text[start..] });
    statements
}

/// Whether a line begins with a keyword. An indented line that contains only a keyword does not count, because the list
/// after `NS_` consists of such lines.
fn starts_statement(line: &str) -> bool {
    let word = line.trim_start().split([' ', '\t', ':', '\r', '\n']).next().unwrap_or_default();
    let is_keyword = word == "VERSION"
        || word.len() > 2 && word.ends_with('_') && word.bytes().all(|b| b.is_ascii_uppercase() || b == b'_');
    let is_listed = line.starts_with([' ', '\t']) && line.trim() == word;
    is_keyword && word != "SG_" && !is_listed
}

/// Puts empty lines in place of removed statements.
fn join(text: &str, statements: &[Statement<'_>]) -> String {
    let mut joined = String::with_capacity(text.len());
    let mut line = 1;
    for statement in statements {
        joined.extend(std::iter::repeat_n('\n', statement.line - line));
        joined.push_str(statement.text);
        line = statement.line + statement.text.matches('\n').count();
    }
    joined
}

impl Statement<'_> {
    fn words(&self) -> impl Iterator<Item = &str> {
        self.text.split([' ', '\t', ':', ';', '\r', '\n']).filter(|word| !word.is_empty())
    }

    /// The identifier as written, if the statement defines a message.
    fn identifier(&self) -> Option<&str> {
        let mut words = self.words();
        if words.next() == Some("BO_") { words.next() } else { None }
    }

    /// Whether the statement defines or describes a message with one of these identifiers.
    fn adds_to(&self, identifiers: &HashSet<String>) -> bool {
        // The identifier is at most the fourth word, as in `BA_ "NAME" SG_ NUMBER`.
        self.words().take(4).skip(1).any(|word| identifiers.contains(word))
    }

    fn fault(&self, line: usize, reason: &str) -> DbcError {
        let name = match self.identifier() {
            Some(_) => self.words().nth(2).map(|name| format!("message {name}")),
            None => self.words().next().filter(|_| starts_statement(self.text)).map(|word| format!("statement {word}")),
        };
        let name = name.unwrap_or_else(|| "text".to_owned());
        DbcError { line, what: format!("{name} is left out: {reason}") }
    }
}

/// Removes all statements about messages with an invalid identifier. The `can-dbc` crate would drop the upper bits of
/// such an identifier, and the rest could equal the identifier of another message.
fn leave_out_bad_identifiers(statements: &mut Vec<Statement<'_>>, left_out: &mut Vec<DbcError>) {
    let mut bad = HashSet::new();
    for statement in statements.iter() {
        let Some(id) = statement.identifier() else { continue };
        let is_bad = match id.parse::<u64>() {
            Ok(id) if id & 0x8000_0000 == 0 => id > 0x7FF,
            // Editors set bit 30 in the identifier of a pseudo message (a container for signals that belong to no
            // message).
            Ok(id) => id > 0xFFFF_FFFF || id & 0x6000_0000 != 0 && !is_pseudo(statement),
            // A number of more than 64 bits is invalid. Text that is not a number is kept here, because the grammar
            // rejects it.
            Err(_) => id.bytes().all(|b| b.is_ascii_digit()),
        };
        if !is_bad {
            continue;
        }
        if !is_pseudo(statement) {
            let allowed = "must be 0 to 2047, or 2147483648 (bit 31, extended) plus 0 to 536870911";
            left_out.push(statement.fault(statement.line, &format!("identifier {id}, {allowed}")));
        }
        bad.insert(id.to_owned());
    }
    if !bad.is_empty() {
        statements.retain(|statement| !statement.adds_to(&bad));
    }
}

fn is_pseudo(statement: &Statement<'_>) -> bool {
    statement.words().nth(2) == Some(super::PSEUDO_MESSAGE)
}

fn grammar_fault(error: &can_dbc::DbcError) -> DbcError {
    match error {
        can_dbc::DbcError::Pest(error) => {
            // The report's last line states what was expected.
            let report = error.to_string();
            let expected = report.lines().rev().find_map(|line| line.trim().strip_prefix("= "));
            let expected = match expected {
                None | Some("expected file") => "must be a statement of a DBC file, such as VERSION or BO_".to_owned(),
                Some(expected) => expected.replace('_', " "),
            };
            let found = error.line().trim().chars().take(MAX_QUOTE).map(|c| if c.is_control() { ' ' } else { c });
            let found: String = found.collect();
            DbcError { line: error_line(&report), what: format!("found \"{found}\", {expected}") }
        }
        other => DbcError { line: 1, what: other.to_string() },
    }
}

/// Line number in pest's report, which starts with ` --> line:column`.
fn error_line(report: &str) -> usize {
    let place = report.lines().next().and_then(|first| first.split("--> ").nth(1));
    place.and_then(|place| place.split(':').next()).and_then(|line| line.trim().parse().ok()).unwrap_or(1)
}
