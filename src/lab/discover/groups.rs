//! Groups signals whose names differ only in their numbers, for example cells or sensors.

use std::collections::{BTreeMap, BTreeSet};

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct SignalGroup {
    /// Name with `{n}` in place of the member's number, and `{m}` in place of other varying numbers.
    pub(crate) pattern: String,
    /// Number of each member, and its index among all names.
    pub(crate) members: Vec<(u32, usize)>,
}

type NumberedName<'a> = (usize, Vec<&'a str>);

/// Returns the groups. Each item of `names` is a partition and a name; names of different partitions are never grouped.
/// Two or more names of a partition form a group if their texts between the numbers are equal. The number that varies
/// most is the member's number; if several vary equally, the last of them is the member's number. If two members have
/// the same number, they are not grouped.
pub(crate) fn groups(names: &[(String, &str)]) -> Vec<SignalGroup> {
    let mut found: BTreeMap<(&str, Vec<&str>), Vec<NumberedName<'_>>> = BTreeMap::new();
    for (index, (partition, name)) in names.iter().enumerate() {
        let (texts, numbers) = split_numbers(name);
        found.entry((partition, texts)).or_default().push((index, numbers));
    }
    let several = found.into_iter().filter(|(_, members)| members.len() >= 2);
    several.filter_map(|((_, texts), members)| group(&texts, &members)).collect()
}

fn group(texts: &[&str], members: &[NumberedName<'_>]) -> Option<SignalGroup> {
    let numbers = &members[0].1;
    let distinct = |at: usize| members.iter().map(|(_, numbers)| numbers[at]).collect::<BTreeSet<&str>>().len();
    let counted = (0..numbers.len()).max_by_key(|at| (distinct(*at), *at)).filter(|at| distinct(*at) >= 2)?;
    let mut pattern = texts[0].to_owned();
    for (at, text) in texts.iter().skip(1).enumerate() {
        let part = match at {
            _ if at == counted => "{n}",
            _ if distinct(at) > 1 => "{m}",
            _ => numbers[at],
        };
        pattern = pattern + part + text;
    }
    let numbered = members.iter().filter_map(|(index, numbers)| Some((numbers[counted].parse().ok()?, *index)));
    let mut numbered: Vec<(u32, usize)> = numbered.collect();
    numbered.sort_unstable();
    numbered.dedup_by_key(|member| member.0);
    (numbered.len() == members.len()).then_some(SignalGroup { pattern, members: numbered })
}

/// Splits a name at its numbers. Returns texts and numbers; there is one more text than numbers.
fn split_numbers(name: &str) -> (Vec<&str>, Vec<&str>) {
    let (mut texts, mut numbers, mut rest) = (Vec::new(), Vec::new(), name);
    while let Some(start) = rest.find(|c: char| c.is_ascii_digit()) {
        let length = rest[start..].bytes().take_while(u8::is_ascii_digit).count();
        texts.push(&rest[..start]);
        numbers.push(&rest[start..start + length]);
        rest = &rest[start + length..];
    }
    texts.push(rest);
    (texts, numbers)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn most_varying_number_counts_the_group() {
        let names = ["Page1.Cell01", "Page1.Cell02", "Page2.Cell03", "Page2.Cell04", "Other.Cell", "Page1.Temp7"];
        let names: Vec<(String, &str)> = names.iter().map(|name| (String::new(), *name)).collect();
        let members = vec![(1, 0), (2, 1), (3, 2), (4, 3)];
        assert_eq!(groups(&names), [SignalGroup { pattern: "Page{m}.Cell{n}".to_owned(), members }]);
    }

    #[test]
    fn other_partitions_and_repeated_numbers_form_no_group() {
        let apart = [("can0".to_owned(), "A.Cell1"), ("can1".to_owned(), "A.Cell2")];
        assert_eq!(groups(&apart), []);
        let doubled = [("".to_owned(), "A1.Cell1"), ("".to_owned(), "A2.Cell1"), ("".to_owned(), "A1.Cell2")];
        assert_eq!(groups(&doubled), [], "two signals for cell 1");
    }
}
