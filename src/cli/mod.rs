//! The command line: parsing, dispatch and exit codes. Each command has its own file; `common` holds what commands
//! share.
#![expect(clippy::print_stderr, reason = "this layer writes to the terminal")]

mod alarms;
mod cells;
mod check;
mod command;
mod common;
#[cfg(feature = "lab")]
mod convert;
mod dbc;
mod demo;
#[cfg(feature = "lab")]
mod diagnose;
#[cfg(feature = "lab")]
mod discover;
mod doctor;
#[cfg(feature = "lab")]
mod export;
mod exporter;
#[cfg(feature = "lab")]
mod fit;
#[cfg(feature = "lab")]
mod fleet;
mod generate;
#[cfg(feature = "lab")]
mod gpr;
mod history;
#[cfg(feature = "lab")]
mod import;
#[cfg(feature = "lab")]
mod look;
mod model;
#[cfg(feature = "lab")]
mod passport;
mod replay;
#[cfg(feature = "lab")]
mod report;
mod reset;
#[cfg(feature = "lab")]
mod rul;
mod run;
#[cfg(feature = "lab")]
mod score;
mod simulate;
mod status;
mod test_alarm;
mod uplink;
#[cfg(feature = "lab")]
mod whatif;

use std::process::ExitCode;

use clap::{CommandFactory as _, FromArgMatches as _, Parser, Subcommand};

/// Streaming battery health monitoring over SocketCAN.
#[derive(Debug, Parser)]
#[command(
    name = "packwatch",
    version,
    about,
    propagate_version = true,
    after_help = "To begin: `packwatch demo` simulates a pack, `packwatch check FILE` checks a configuration, and \
    `packwatch run -c FILE` starts the service. `packwatch COMMAND --help` describes a command."
)]
pub struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run the service on live CAN interfaces
    Run(Box<run::Args>),
    /// Show the status of the running daemon: pack, cells, alarms, interfaces
    Status(status::Args),
    /// Serve the status of the running daemon as a live page and as metrics for Prometheus
    Exporter(exporter::Args),
    /// Send the status of the running daemon to an MQTT broker (needs packwatch-uplink)
    #[command(disable_help_flag = true)]
    Mqtt(uplink::Args),
    /// Send the status of the running daemon to a KUKSA databroker (needs packwatch-uplink)
    #[command(disable_help_flag = true)]
    Kuksa(uplink::Args),
    /// Serve status and faults of the running daemon to SOVD testers (needs packwatch-uplink)
    #[command(disable_help_flag = true)]
    Sovd(uplink::Args),
    /// Write the VSS overlay for KUKSA (needs packwatch-uplink)
    #[command(disable_help_flag = true)]
    Vss(uplink::Args),
    /// Show the alarms of the running daemon
    Alarms(alarms::Args),
    /// Acknowledge alarms of the running daemon
    Acknowledge(command::AlarmArgs),
    /// Clear latched alarms of the running daemon whose value is healthy again; keep all learned values
    Clear(command::AlarmArgs),
    /// Tell the running daemon that another pack is connected
    PackReplaced(command::ReplacedArgs),
    /// Suspend or resume the diagnostic requests of the running daemon
    Poll(command::PollArgs),
    /// Discard the learned values, with or without a running daemon
    Reset(reset::Args),
    /// List, export or verify the stored history
    History(Box<history::Args>),
    /// Send the alarm frame of a rule, marked as a test, and report the frames seen on every interface
    TestAlarm(test_alarm::Args),
    /// Replay journals, candump logs or CSV files through the same core as `run`
    Replay(Box<replay::Args>),
    /// Simulate an ageing pack as a candump log or as frames on an interface
    Simulate(Box<simulate::Args>),
    /// Simulate a short battery life that ends in alarms; needs no files or interfaces
    Demo(demo::Args),
    /// Check a configuration and show the DBC signal behind each configured signal
    Check(check::Args),
    /// Listen to a pack or replay a log, and report probable wiring and configuration faults
    Doctor(Box<doctor::Args>),
    /// Find failing cells of a pack and their faults: leaks, contacts, weak cells, sensors
    #[cfg(feature = "lab")]
    Diagnose(Box<diagnose::Args>),
    /// List the installed cell models, and the chemistries for use without a model
    Cells(cells::Args),
    /// Show, plot, export or compare cell models
    Model(Box<model::Args>),
    /// Write a DBC of the configured output frames, for receivers
    Dbc(dbc::Args),
    /// Write manual pages and shell completions
    #[command(hide = true)]
    Generate(generate::Args),
    /// Fit a cell model to measured data
    #[cfg(feature = "lab")]
    Fit(Box<fit::Args>),
    /// Find the signals of the traction battery in a log
    #[cfg(feature = "lab")]
    Discover(discover::Args),
    /// Make a report from logs in one step: find the signals, check the wiring, replay
    #[cfg(feature = "lab")]
    Look(look::Args),
    /// Convert signal lists of a car, or a BPX cell, to configuration files
    #[cfg(feature = "lab")]
    Import(import::Args),
    /// Replay measured files and compare the estimates with the true values
    #[cfg(feature = "lab")]
    Score(Box<score::Args>),
    /// Forecast the remaining useful life from measured capacity histories
    #[cfg(feature = "lab")]
    Rul(rul::Args),
    /// Fit and use Gaussian process regression on CSV files
    #[cfg(feature = "lab")]
    Gpr(Box<gpr::Args>),
    /// Compare alarm settings across recorded logs
    #[cfg(feature = "lab")]
    Whatif(Box<whatif::Args>),
    /// Write the frames of logs in any known format as a candump log, MF4 or MCAP
    #[cfg(feature = "lab")]
    Convert(Box<convert::Args>),
    /// Write the estimates, half-cycles and alarms of many logs as Parquet or CSV
    #[cfg(feature = "lab")]
    Export(Box<export::Args>),
    /// Replay the vehicles of a fleet in shards, on any machines, and merge their tables
    #[cfg(feature = "lab")]
    Fleet(fleet::Args),
    /// Write an HTML report on the condition and history of a battery
    #[cfg(feature = "lab")]
    Report(Box<report::Args>),
    /// Write a battery passport: measured values merged with the manufacturer's data
    #[cfg(feature = "lab")]
    Passport(Box<passport::Args>),
}

/// Parses the command line and runs the command.
pub fn main() -> ExitCode {
    let matches = with_negative_numbers(Cli::command()).get_matches();
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.exit());
    let result = match cli.command {
        Command::Run(args) => run::run(&args),
        Command::Status(args) => status::run(&args),
        Command::Exporter(args) => exporter::run(&args),
        Command::Mqtt(args) => uplink::run("mqtt", &args),
        Command::Kuksa(args) => uplink::run("kuksa", &args),
        Command::Sovd(args) => uplink::run("sovd", &args),
        Command::Vss(args) => uplink::run("vss", &args),
        Command::Alarms(args) => alarms::run(&args),
        Command::Acknowledge(args) => command::acknowledge(&args),
        Command::Clear(args) => command::clear(&args),
        Command::PackReplaced(args) => command::pack_replaced(&args),
        Command::Poll(args) => command::poll(&args),
        Command::Reset(args) => reset::run(&args),
        Command::History(args) => history::run(&args),
        Command::TestAlarm(args) => test_alarm::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::Check(args) => check::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        #[cfg(feature = "lab")]
        Command::Diagnose(args) => diagnose::run(&args),
        Command::Cells(args) => cells::run(&args),
        Command::Model(args) => model::run(&args),
        Command::Dbc(args) => dbc::run(&args),
        Command::Generate(args) => generate::run(&args, &Cli::command()),
        #[cfg(feature = "lab")]
        Command::Fit(args) => fit::run(&args),
        #[cfg(feature = "lab")]
        Command::Discover(args) => discover::run(&args),
        #[cfg(feature = "lab")]
        Command::Look(args) => look::run(&args),
        #[cfg(feature = "lab")]
        Command::Import(args) => import::run(&args),
        #[cfg(feature = "lab")]
        Command::Score(args) => score::run(&args),
        #[cfg(feature = "lab")]
        Command::Rul(args) => rul::run(&args),
        #[cfg(feature = "lab")]
        Command::Gpr(args) => gpr::run(&args),
        #[cfg(feature = "lab")]
        Command::Whatif(args) => whatif::run(&args),
        #[cfg(feature = "lab")]
        Command::Convert(args) => convert::run(&args),
        #[cfg(feature = "lab")]
        Command::Export(args) => export::run(&args),
        #[cfg(feature = "lab")]
        Command::Fleet(args) => fleet::run(&args),
        #[cfg(feature = "lab")]
        Command::Report(args) => report::run(&args),
        #[cfg(feature = "lab")]
        Command::Passport(args) => passport::run(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            if !failure.message.is_empty() {
                common::output::note(failure.message);
            }
            ExitCode::from(failure.code)
        }
    }
}

/// Lets every option accept a negative number. The option's own parser then rejects `--sleep-gap -1` and states what is
/// allowed. Otherwise clap would report `-1` as an unknown option.
fn with_negative_numbers(command: clap::Command) -> clap::Command {
    let accept = |arg: clap::Arg| {
        let takes_value = !arg.is_positional() && arg.get_action().takes_values();
        if takes_value { arg.allow_negative_numbers(true) } else { arg }
    };
    command.mut_args(accept).mut_subcommands(with_negative_numbers)
}
