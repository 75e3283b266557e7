//! The binary: parse, dispatch, exit code.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// What packwatch knows, for other software.
#[derive(Debug, Parser)]
#[command(name = "packwatch-uplink", version, about, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {}

fn main() -> ExitCode {
    match Cli::parse().command {}
}
