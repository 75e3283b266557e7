//! The program `packwatch-uplink`: parses the command line, runs the command and returns its exit code.
#![expect(clippy::print_stderr, reason = "this program writes to the terminal")]

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use packwatch_host::io::text_table::printable;
use packwatch_uplink::{Options, kuksa, mqtt, sovd, vss};

/// Send the status of the packwatch daemon to MQTT brokers, KUKSA databrokers and SOVD testers.
#[derive(Debug, Parser)]
#[command(name = "packwatch-uplink", version, about, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Send the status of the running daemon to an MQTT broker, with discovery for Home Assistant
    Mqtt(Options),
    /// Provide the status of the running daemon to a KUKSA databroker
    Kuksa(Options),
    /// Serve values and faults as a component of ASAM SOVD (read-only JSON over HTTP on this computer)
    Sovd(Options),
    /// Write the overlay of the Vehicle Signal Specification (VSS) for KUKSA
    Vss(vss::Args),
}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Mqtt(options) => mqtt::run(&options),
        Command::Kuksa(options) => kuksa::run(&options),
        Command::Sovd(options) => sovd::run(&options),
        Command::Vss(args) => vss::run(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("{}", printable(&failure.message));
            ExitCode::from(failure.code)
        }
    }
}
