//! Implements `--set KEY=V1,V2`: replaces values of a configuration, and builds all combinations of the replaced
//! values.
//!
//! Input: the file of a configuration, and choices (one per `--set`). Output: the original configuration, then one
//! checked configuration per combination. Each has the number of its replay. Combinations share a replay if their
//! configurations differ only in `[[alarm]]` tables. Tables of the rule `input_missing` are an exception: if they
//! differ, the replays are separate, because the time-outs of this rule also affect the inputs of the alarms. A
//! combination that is not a valid configuration is left out and reported.
//!
//! | key | meaning |
//! | --- | --- |
//! | `RULE.info`, `RULE.warning`, `RULE.severe`, each also with `.set` or `.clear` | threshold |
//! | `RULE.threshold` | most severe threshold in the file |
//! | `RULE.probability` | `when = { probability = ... }` |
//! | `RULE.` and any other key of an `[[alarm]]` table | this key in all tables of the rule |
//! | any other dotted key | key of the configuration; `[n]`, from 1, selects one of several tables |

mod target;

use std::path::Path;

use toml::{Table, Value};

use self::target::{Target, name_rules, rule_of, targets};
use crate::alarm::Rule;
use crate::config::{self, Config, ConfigFiles};

/// Maximum number of combinations. A longer table is not readable.
pub const MAX_COMBINATIONS: usize = 1000;
/// One `--set` option.
#[derive(Debug, Clone, PartialEq)]
pub struct Choice {
    /// The key as written.
    pub key: String,
    values: Vec<(String, Value)>,
}

impl std::str::FromStr for Choice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = "must be KEY=VALUE[,VALUE...], for example capacity_low.warning=1.5,1.6";
        let (key, values) = text.split_once('=').ok_or(expected)?;
        let key = key.trim().to_owned();
        let parts = split(values);
        if key.is_empty() || key.split('.').any(str::is_empty) || parts.iter().any(|part| part.is_empty()) {
            return Err(expected.to_owned());
        }
        if let Some(twice) = (1..parts.len()).find(|&index| parts[..index].contains(&parts[index])) {
            return Err(format!("value {} given twice", parts[twice]));
        }
        let values = parts.into_iter().map(|part| (part.to_owned(), value(part))).collect();
        Ok(Self { key, values })
    }
}

/// Splits a text at the commas outside quotes and brackets.
fn split(text: &str) -> Vec<&str> {
    let (mut parts, mut from, mut depth, mut quote) = (Vec::new(), 0, 0_i32, None);
    for (at, letter) in text.char_indices() {
        match (quote, letter) {
            (Some(open), _) => quote = if letter == open { None } else { quote },
            (None, '"' | '\'') => quote = Some(letter),
            (None, '{' | '[') => depth += 1,
            (None, '}' | ']') => depth -= 1,
            (None, ',') if depth == 0 => {
                parts.push(text[from..at].trim());
                from = at + 1;
            }
            (None, _) => {}
        }
    }
    parts.push(text[from..].trim());
    parts
}

/// Parses a value as TOML. A text that is not TOML becomes a string (`80 %`, `mean`).
fn value(text: &str) -> Value {
    let parsed = format!("value = {text}").parse::<Table>().ok();
    parsed.and_then(|mut table| table.remove("value")).unwrap_or_else(|| Value::String(text.to_owned()))
}

/// One combination.
#[derive(Debug, Clone)]
pub struct Variant {
    /// Replaced values as written, in the order of the choices; empty = the original configuration.
    pub values: Vec<String>,
    /// The configuration with these values.
    pub config: Config,
    /// Combinations with the same number share a replay.
    pub replay: usize,
}

/// All combinations.
#[derive(Debug, Clone)]
pub struct VariantGrid {
    /// Keys as written.
    pub keys: Vec<String>,
    /// The original configuration, followed by every combination.
    pub variants: Vec<Variant>,
    /// Number of replays per log.
    pub replays: usize,
    /// Rules named by the choices.
    pub rules: Vec<Rule>,
    /// Whether keys outside `[[alarm]]` tables were replaced.
    pub other_keys: bool,
    /// Notes for the user.
    pub notes: Vec<String>,
}

/// Builds the grid.
///
/// # Errors
/// The configuration is faulty, a key is unknown, there are too many combinations, or no combination is valid.
pub fn grid(path: &Path, choices: &[Choice]) -> Result<VariantGrid, Vec<String>> {
    let plain = config::load(path).map_err(|faults| faults.0)?;
    let root = read(path)?;
    let mut grid = VariantGrid {
        keys: choices.iter().map(|choice| choice.key.clone()).collect(),
        variants: Vec::new(),
        replays: 0,
        rules: Vec::new(),
        other_keys: false,
        notes: Vec::new(),
    };
    let targets = targets(&mut grid, &root, choices).map_err(|fault| vec![fault])?;
    let mut replays = vec![replay_key(&root)];
    grid.variants.push(Variant { values: Vec::new(), config: plain, replay: 0 });
    let (mut refused, mut first_refused) = (0, Vec::new());
    for combination in combinations(choices).map_err(|fault| vec![fault])? {
        let values = combination.iter().map(|(text, _)| text.clone()).collect();
        match variant(path, &root, &targets, &combination) {
            Ok((config, key)) => {
                let known = replays.iter().position(|other| *other == key);
                let replay = known.unwrap_or(replays.len());
                replays.extend(known.is_none().then_some(key));
                grid.variants.push(Variant { values, config, replay });
            }
            Err(faults) => {
                refused += 1;
                if first_refused.is_empty() {
                    let set: Vec<_> =
                        grid.keys.iter().zip(&combination).map(|(k, (v, _))| format!("{k}={v}")).collect();
                    // The note quotes at most three faults of the first invalid combination.
                    first_refused = faults.iter().take(3).map(|f| format!("{}: {f}", set.join(" "))).collect();
                }
            }
        }
    }
    grid.replays = replays.len();
    if refused > 0 && grid.variants.len() == 1 {
        return Err(first_refused);
    }
    if refused > 0 {
        let first = first_refused.join("; ");
        grid.notes.push(format!("{refused} combinations are not valid configurations and are left out: {first}"));
    }
    Ok(grid)
}

/// Returns the configuration of a combination and its replay key. Combinations with equal keys share a replay.
fn variant(
    path: &Path,
    root: &Table,
    targets: &[Target],
    combination: &[&(String, Value)],
) -> Result<(Config, String), Vec<String>> {
    let mut root = root.clone();
    for (target, (_, value)) in targets.iter().zip(combination) {
        target.set(&mut root, value).map_err(|fault| vec![fault])?;
    }
    let text = toml::to_string(&root).map_err(|error| vec![error.to_string()])?;
    let read = |file: &Path| if file == path { Ok(text.clone().into_bytes()) } else { std::fs::read(file) };
    let config = config::load_with(&ConfigFiles::alone(path), &read).map_err(|faults| {
        // The line numbers refer to a generated text, so they are removed.
        let file = format!("{}:", path.display());
        let without_line = |fault: &String| {
            let rest = fault.strip_prefix(&file).map(|rest| rest.trim_start_matches(|c: char| c.is_ascii_digit()));
            rest.and_then(|rest| rest.strip_prefix(": ")).unwrap_or(fault).to_owned()
        };
        faults.0.iter().map(without_line).map(|fault| name_rules(fault, targets)).collect::<Vec<_>>()
    })?;
    Ok((config, replay_key(&root)))
}

fn read(path: &Path) -> Result<Table, Vec<String>> {
    let text = config::merged(path).map_err(|faults| faults.0)?;
    text.parse::<Table>().map_err(|error| vec![format!("{}: {}", path.display(), error.message())])
}

/// Returns everything in a configuration that can affect estimates or the values of rules.
fn replay_key(root: &Table) -> String {
    let mut root = root.clone();
    if let Some(Value::Array(alarms)) = root.get_mut("alarm") {
        alarms.retain(|alarm| rule_of(alarm) == Some(Rule::InputMissing.name()));
    }
    // A parsed table can always be written as text. If this failed, its debug form would serve as the key.
    toml::to_string(&root).unwrap_or_else(|error| format!("{error} {root:?}"))
}

/// Returns every combination; the last choice changes fastest. Without choices, the list is empty.
fn combinations(choices: &[Choice]) -> Result<Vec<Vec<&(String, Value)>>, String> {
    if choices.is_empty() {
        return Ok(Vec::new());
    }
    let count = choices.iter().try_fold(1_usize, |count, choice| count.checked_mul(choice.values.len()));
    let Some(count) = count.filter(|count| *count <= MAX_COMBINATIONS) else {
        let lists: Vec<_> = choices.iter().map(|choice| choice.values.len().to_string()).collect();
        return Err(format!("--set: {} combinations, must be at most {MAX_COMBINATIONS}", lists.join(" x ")));
    };
    let mut all: Vec<Vec<&(String, Value)>> = Vec::with_capacity(count);
    all.push(Vec::new());
    for choice in choices {
        let longer = |so_far: &Vec<_>| {
            let so_far = so_far.clone();
            choice.values.iter().map(move |value| so_far.iter().copied().chain([value]).collect())
        };
        all = all.iter().flat_map(longer).collect();
    }
    Ok(all)
}

#[cfg(test)]
mod tests;
