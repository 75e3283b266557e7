//! `packwatch check`: checks a configuration and describes it.
//!
//! Opens every file that the configuration names. If the configuration is valid, prints warnings and then its
//! description on standard output; the exit code is 0. If the configuration is not valid, prints each fault on its own
//! line of standard error; the exit code is 78.

use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use super::common::output;
use super::common::output::{print, print_json, unless_closed};
use crate::config::{Description, KeySource, OutputUse, SignalUse};
use crate::io::can_key::CanKey;
use packwatch_host::bounded_file;
use packwatch_host::failure::Failure;

/// Arguments of `check`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration file
    #[arg(required_unless_present = "reference")]
    file: Option<PathBuf>,
    /// Print the description as JSON
    #[arg(long)]
    json: bool,
    /// Print the configuration as TOML, merged with its drop-ins (FILE.d/*.toml), with the file and line of each part.
    /// If there are faults, report them afterwards
    #[arg(long, conflicts_with = "json")]
    merged: bool,
    /// Print the reference of all configuration keys as Markdown
    #[arg(long, conflicts_with_all = ["file", "json", "merged"])]
    reference: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let Some(file) = &args.file else {
        return print(&crate::config::reference());
    };
    if args.merged {
        print(&crate::config::merged(file)?)?;
    }
    let description = crate::config::describe(file)?;
    check_key(file)?;
    if args.merged {
        return Ok(());
    }
    if args.json {
        unless_closed(print_json(&description))
    } else {
        let mut page = String::new();
        show(&description, &mut page);
        print(&page)
    }
}

/// Checks the key file of `[authentication]`. Skips the check if this user has no permission to read the file.
fn check_key(file: &Path) -> Result<(), Failure> {
    let Some(KeySource::File(path)) = crate::config::load(file)?.key else { return Ok(()) };
    if bounded_file::open(&path).is_err_and(|error| error.kind() == io::ErrorKind::PermissionDenied) {
        return Ok(());
    }
    // Root may check the file of another user, who runs the daemon.
    let user = nix::unistd::geteuid();
    let owner = path.metadata().map_or(0, |found| found.uid());
    CanKey::read(&path, Some(if user.is_root() { owner } else { user.as_raw() })).map(drop).map_err(Failure::config)
}

fn show(description: &Description, page: &mut String) {
    page.push_str(&format!("{}: {}\n", description.file, verdict(description.warnings.len())));
    for file in &description.drop_ins {
        page.push_str(&format!("  with {file}\n"));
    }
    if !description.warnings.is_empty() {
        list("warnings", &description.warnings, "", page);
    }
    if description.vehicle.is_stated() {
        page.push_str(&format!("\nvehicle\n  {}\n", description.vehicle));
    }
    page.push_str(&format!("\ncell\n  {}\n", description.cell));
    list("pack", &description.pack, "", page);
    page.push_str("\ninterfaces\n");
    for interface in &description.interfaces {
        let kind = if interface.fd { "classic and FD" } else { "classic" };
        let mut ids = match interface.filter_ids.len() {
            0 => "no message read".to_owned(),
            _ => format!("kernel filter {}", interface.filter_ids.join(" ")),
        };
        if !interface.own_ids.is_empty() {
            ids.push_str(&format!("; also own ids, to detect other senders of them: {}", interface.own_ids.join(" ")));
        }
        page.push_str(&format!("  {}: {kind}, {ids}\n", interface.name));
    }
    let has_direction = description.signals.iter().any(|signal| signal.channel == "direction of the current");
    let signals = description.signals.iter().map(|of| signal(of, has_direction));
    list("signals", &table(signals), "", page);
    list("plausible readings", &description.limits, "", page);
    list("checks of frames", &description.intake, "", page);
    list("diagnostic requests", &description.polling, "none sent", page);
    list("outputs", &table(description.outputs.iter().map(sent)), "none sent", page);
    list("alarms", &description.alarms, "none", page);
    if !description.j1939.is_empty() {
        list("j1939", &description.j1939, "", page);
    }
}

/// The result, shown in the first line of the output.
fn verdict(warnings: usize) -> String {
    match warnings {
        0 => "good".to_owned(),
        1 => "usable, 1 warning".to_owned(),
        _ => format!("usable, {warnings} warnings"),
    }
}

/// Appends a heading and the indented `lines`. If `lines` is empty, appends the text in `none`.
fn list(heading: &str, lines: &[String], none: &str, page: &mut String) {
    page.push_str(&format!("\n{heading}\n"));
    for line in lines.iter().map(String::as_str).chain(Some(none).filter(|none| lines.is_empty() && !none.is_empty())) {
        page.push_str(&format!("  {line}\n"));
    }
}

/// Rows with their columns aligned.
fn table(rows: impl Iterator<Item = Vec<String>>) -> Vec<String> {
    output::table::<&str>(&[], rows, usize::MAX).lines().map(str::to_owned).collect()
}

/// The row of a signal. If `has_direction` is true, the current is a magnitude, and another signal states its
/// direction.
fn signal(signal: &SignalUse, has_direction: bool) -> Vec<String> {
    let page = if signal.multiplex.is_empty() { String::new() } else { format!(" [{}]", signal.multiplex) };
    let mut notes = Vec::new();
    if signal.channel == "pack current" && has_direction {
        notes.push("magnitude".to_owned());
    } else if signal.scale < 0.0 {
        notes.push("positive = charge on the bus".to_owned());
    } else if signal.channel == "pack current" {
        notes.push("positive = discharge on the bus".to_owned());
    }
    if signal.scale.abs() != 1.0 {
        notes.push(format!("scaled by {}", signal.scale.abs()));
    }
    if signal.added != 0.0 {
        notes.push(format!("plus {}", signal.added));
    }
    notes.extend(signal.serves.clone());
    if !signal.not_available.is_empty() {
        notes.push(format!("not available {}", signal.not_available.join(" ")));
    }
    let range = match signal.range {
        Some([low, high]) => format!("{low} to {high}"),
        None => "no range in the DBC".to_owned(),
    };
    vec![
        signal.channel.clone(),
        signal.interface.clone(),
        signal.id.clone(),
        format!("{}.{}{page}", signal.message, signal.signal),
        format!("bit {} length {} {} {}", signal.start_bit, signal.length_bits, signal.byte_order, signal.value_type),
        format!("x {} + {} {}", signal.factor, signal.offset, signal.unit),
        range,
        notes.join("; "),
    ]
}

fn sent(output: &OutputUse) -> Vec<String> {
    vec![
        output.frame.to_owned(),
        output.id.clone(),
        output.interfaces.join(" "),
        output.period_ms.map_or("on a command".to_owned(), |period_ms| format!("every {period_ms} ms")),
        output.kind.to_owned(),
        match (output.protection.as_str(), output.authentication.as_str()) {
            ("none", "none") => "no end-to-end protection".to_owned(),
            (protection, "none") => format!("end-to-end {protection}"),
            ("none", authentication) => format!("authenticated, {authentication}"),
            (protection, authentication) => format!("end-to-end {protection}; authenticated, {authentication}"),
        },
    ]
}
