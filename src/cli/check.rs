//! `packwatch check`: says whether a configuration is good, and what it means.
//!
//! Opens everything the configuration names. Good: the meaning on standard output, exit 0. Bad: every fault,
//! one a line, on standard error, exit 78.

use std::path::PathBuf;

use super::Failure;
use crate::config::{Description, OutputUse, SignalUse};

/// Arguments of `check`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration file
    #[arg(required_unless_present = "reference")]
    file: Option<PathBuf>,
    /// Print the meaning as JSON
    #[arg(long)]
    json: bool,
    /// Print the reference of all keys and do nothing else
    #[arg(long, conflicts_with_all = ["file", "json"])]
    reference: bool,
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let Some(file) = &args.file else {
        print!("{}", crate::config::reference());
        return Ok(());
    };
    let description = crate::config::describe(file)?;
    if args.json {
        let json = serde_json::to_string_pretty(&description);
        println!("{}", json.map_err(|error| Failure::new(format!("cannot be written as JSON: {error}")))?);
    } else {
        show(&description);
    }
    Ok(())
}

fn show(description: &Description) {
    println!("{}: good", description.file);
    println!("\ncell\n  {}", description.cell);
    list("pack", &description.pack);
    println!("\ninterfaces");
    for interface in &description.interfaces {
        let kind = if interface.fd { "classic and FD" } else { "classic" };
        let ids = match interface.filter_ids.len() {
            0 => "nothing is read".to_owned(),
            _ => format!("kernel filter {}", interface.filter_ids.join(" ")),
        };
        println!("  {}: {kind}, {ids}", interface.name);
    }
    println!("\nsignals");
    table(&description.signals.iter().map(signal).collect::<Vec<_>>());
    list("plausible readings", &description.limits);
    println!("\noutputs");
    if description.outputs.is_empty() {
        println!("  nothing is sent");
    }
    table(&description.outputs.iter().map(output).collect::<Vec<_>>());
    if description.alarms.is_empty() {
        list("alarms", &["none".to_owned()]);
    } else {
        list("alarms", &description.alarms);
    }
}

fn list(heading: &str, lines: &[String]) {
    println!("\n{heading}");
    for line in lines {
        println!("  {line}");
    }
}

fn signal(signal: &SignalUse) -> Vec<String> {
    let page = if signal.multiplex.is_empty() { String::new() } else { format!(" [{}]", signal.multiplex) };
    let mut notes = Vec::new();
    if signal.scale < 0.0 {
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

fn output(output: &OutputUse) -> Vec<String> {
    vec![
        output.frame.to_owned(),
        output.id.clone(),
        output.interfaces.join(" "),
        format!("every {} ms", output.period_ms),
    ]
}

/// Rows with their columns aligned.
fn table(rows: &[Vec<String>]) {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max();
    let widths: Vec<usize> = (0..columns).map(|column| width(column).unwrap_or(0)).collect();
    for row in rows {
        let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        println!("  {}", cells.join("  ").trim_end());
    }
}
