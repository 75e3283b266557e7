//! The binary: parse, dispatch, exit code.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use packwatch_host::logging;
use packwatch_uplink::mqtt;
use packwatch_uplink::settings::Settings;

/// What packwatch knows, for other software.
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
}

/// Options of every command.
#[derive(Debug, clap::Args)]
struct Options {
    /// Settings of the uplink
    #[arg(short, long, value_name = "FILE", default_value = "/etc/packwatch/uplink.toml")]
    config: PathBuf,
    /// Log level or filter: error, warn, info, debug, trace (default: $PACKWATCH_LOG, else info)
    #[arg(long, value_name = "LEVEL")]
    log: Option<String>,
}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Mqtt(options) => run(&options, mqtt::run),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            #[expect(clippy::print_stderr, reason = "the message of a command line")]
            {
                eprintln!("{message}");
            }
            ExitCode::FAILURE
        }
    }
}

/// Starts the log, reads the settings and runs a command with them.
fn run(options: &Options, command: fn(&Settings) -> Result<(), String>) -> Result<(), String> {
    logging::start(options.log.as_deref())?;
    let settings = Settings::read(&options.config)?;
    command(&settings).map_err(|error| format!("{}: {error}", options.config.display()))
}
