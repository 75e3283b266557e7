//! `vss`: writes an overlay of the Vehicle Signal Specification (VSS). The overlay contains the signals that VSS does
//! not have.
//!
//! Input: the branch in the settings. Output: `packwatch.vspec`, which vss-tools merge into VSS
//! (`vspec export json -l`), and `packwatch.json`, which a databroker reads in addition to VSS's own file
//! (`--vss vss.json,packwatch.json`). `--reference` prints every signal as Markdown, for the manual.

use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::PathBuf;

use serde_json::{Map, Value, json};

use crate::Failure;
use crate::kuksa::settings::KuksaSettings;
use crate::kuksa::signals::{self, Origin, STANDARD_BRANCH, Signal};
use crate::settings::Settings;

/// Name of both files without extension.
const FILE_NAME: &str = "packwatch";

/// Arguments of `vss`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Settings file of the uplink
    #[arg(short, long, value_name = "FILE", required_unless_present = "reference")]
    config: Option<PathBuf>,
    /// Folder to write packwatch.vspec and packwatch.json to
    #[arg(short, long, value_name = "DIR", default_value = ".")]
    output: PathBuf,
    /// Print all signals, including those of VSS, as a page of the manual; write no files
    #[arg(long)]
    reference: bool,
}

/// Runs the command.
///
/// # Errors
/// Fails if the settings are invalid or a file cannot be written.
pub fn run(args: &Args) -> Result<(), Failure> {
    let Some(config) = args.config.as_ref().filter(|_| !args.reference) else {
        return std::io::stdout()
            .write_all(reference().as_bytes())
            .map_err(|error| Failure::new(format!("output: {error}")));
    };
    let branch = Settings::read(config).map_err(Failure::config)?.kuksa.branch;
    for (ending, text) in [("vspec", vspec(&branch)), ("json", json_text(&branch))] {
        let path = args.output.join(format!("{FILE_NAME}.{ending}"));
        std::fs::write(&path, text)
            .map_err(|error| Failure::new(format!("{}: cannot be written: {error}", path.display())))?;
    }
    Ok(())
}

/// Description of a branch below the configured one.
fn description(branch: &str) -> &'static str {
    match branch {
        "Alarms" => "Raised alarms and configured thresholds.",
        "Capacity" => "Capacity of the weakest cell.",
        "Cells" => {
            "Values of each cell. An array has a value only if every cell has one; cells are identified by relative \
                    position in array."
        }
        "Charging" => "The charge in progress.",
        "CurrentSensor" => "The current sensor.",
        "Energy" => "Energy and time to full and to empty.",
        "Loss" => "Losses of the weakest cell.",
        "Model" => "The cell model.",
        "Power" => "Power that the pack can deliver or take up.",
        "RechargePeriod" => "Recharge period.",
        "RemainingLife" => "Remaining life of the cell that ends first.",
        "StateOfCharge" => "Additional signals of the state of charge.",
        "StateOfHealth" => "Additional signals of the state of health.",
        "Use" => "How the pack was used.",
        _ => "Battery health estimated by packwatch.",
    }
}

/// Branches that the overlay must define, parents first, with descriptions.
fn branches(branch: &str) -> Vec<(String, &'static str)> {
    let is_known = |path: &str| STANDARD_BRANCH == path || STANDARD_BRANCH.starts_with(&format!("{path}."));
    let parents = branch.match_indices('.').map(|(end, _)| &branch[..end]);
    let own = parents.chain([branch]).filter(|path| !is_known(path)).map(|path| (path.to_owned(), description("")));
    let inner: BTreeSet<&str> =
        signals::of_overlay().filter_map(|signal| Some(signal.name.split_once('.')?.0)).collect();
    own.chain(inner.into_iter().map(|name| (format!("{branch}.{name}"), description(name)))).collect()
}

/// The overlay as vspec: YAML with full paths. JSON strings are valid YAML strings.
fn vspec(branch: &str) -> String {
    let mut text = format!("# Overlay of packwatch {}, written by \"packwatch vss\".\n", env!("CARGO_PKG_VERSION"));
    for (path, description) in branches(branch) {
        let _ = write!(text, "\n{path}:\n  type: branch\n  description: {}\n", json!(description));
    }
    for signal in signals::of_overlay() {
        let _ = write!(text, "\n{}:\n  type: sensor\n  datatype: {}\n", signal.path(branch), signal.data_type.name());
        if let Some(unit) = signal.unit {
            let _ = writeln!(text, "  unit: {unit}");
        }
        let _ = writeln!(text, "  description: {}\n  comment: {}", json!(signal.description), json!(comment(signal)));
    }
    text
}

fn comment(signal: &Signal) -> String {
    format!("Of packwatch's status document: {}.", signal.fields)
}

/// The overlay as the databroker reads it: a tree starting at `Vehicle`.
fn json_text(branch: &str) -> String {
    let mut root = Map::new();
    for (path, description) in branches(branch) {
        *node(&mut root, &path) = json!({ "type": "branch", "description": description, "children": {} });
    }
    for signal in signals::of_overlay() {
        *node(&mut root, &signal.path(branch)) = leaf(signal);
    }
    format!("{:#}\n", Value::Object(root))
}

fn leaf(signal: &Signal) -> Value {
    let mut leaf = json!({
        "type": "sensor",
        "datatype": signal.data_type.name(),
        "description": signal.description,
        "comment": comment(signal),
    });
    if let Some(unit) = signal.unit {
        leaf["unit"] = json!(unit);
    }
    leaf
}

/// Returns the node of `path` in the tree; creates missing VSS branches.
fn node<'a>(root: &'a mut Map<String, Value>, path: &str) -> &'a mut Value {
    match path.rsplit_once('.') {
        None => {
            root.entry(path).or_insert_with(|| json!({ "type": "branch", "description": "See VSS.", "children": {} }))
        }
        Some((parent, name)) => {
            let parent = node(root, parent);
            if parent.is_null() {
                *parent = json!({ "type": "branch", "description": "See VSS.", "children": {} });
            }
            &mut parent["children"][name]
        }
    }
}

/// The manual page: a table of VSS signals and one of overlay signals.
fn reference() -> String {
    let mut page = "# VSS signals\n\nWritten by `packwatch vss --reference`: the signals that are not in the table of [quantities](quantities.md). A signal \
                    has no value while the daemon is silent, while one of its fields in the [status document](status.md) is unknown, or \
                    in the cases that the column `remark` states. Cells count from 0. An array has a value only if every cell has \
                    one, because VSS has no unknown number.\n"
        .to_owned();
    for (title, origin) in [("Standard signals", Origin::Standard), ("Overlay signals", Origin::Overlay)] {
        let branch =
            if origin == Origin::Standard { STANDARD_BRANCH.to_owned() } else { KuksaSettings::default().branch };
        let _ = write!(page, "\n## {title}\n\nBelow `{branch}`.\n\n");
        page.push_str("| signal | datatype | unit | status field | remark |\n| --- | --- | --- | --- | --- |\n");
        for signal in signals::all().filter(|signal| signal.origin == origin && !signal.is_quantity()) {
            let Signal { name, data_type, fields, description, .. } = signal;
            let _ = writeln!(
                page,
                "| `{name}` | {} | {} | {fields} | {description} |",
                data_type.name(),
                signal.unit.unwrap_or("")
            );
        }
    }
    page
}

#[cfg(test)]
mod tests;
