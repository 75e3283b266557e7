//! `packwatch mqtt`, `kuksa` and `vss`: start the program `packwatch-uplink`, a package of its own, in place of this process.
//!
//! It is looked for next to this program, then in the folders of `PATH`.

use std::ffi::OsString;
use std::io;
use std::os::unix::process::CommandExt as _;
use std::path::PathBuf;
use std::process::Command;

use packwatch_host::failure::Failure;

/// Name of the program.
const PROGRAM: &str = "packwatch-uplink";

/// Arguments of these commands: those of the other program, which also prints their help.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Arguments of the command: `--help` lists them
    #[arg(value_name = "ARG", trailing_var_arg = true, allow_hyphen_values = true)]
    arguments: Vec<OsString>,
}

/// Becomes the other program; returns only when that fails.
pub(crate) fn run(command: &str, args: &Args) -> Result<(), Failure> {
    let error = Command::new(program()).arg(command).args(&args.arguments).exec();
    Err(Failure::new(match error.kind() {
        io::ErrorKind::NotFound => format!(
            "packwatch {command}: {PROGRAM} is not installed: it is the package of that name, or \"cargo install --path src/uplink\""
        ),
        _ => format!("packwatch {command}: {PROGRAM}: {error}"),
    }))
}

/// The program next to this one; else its name, for `PATH`.
fn program() -> PathBuf {
    let beside = std::env::current_exe().ok().map(|own| own.with_file_name(PROGRAM));
    beside.filter(|path| path.is_file()).unwrap_or_else(|| PROGRAM.into())
}
