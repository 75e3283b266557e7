//! `packwatch generate`: writes manual pages and shell completions from the definition of the command line. The command
//! is hidden, because only package builds use it.

use std::path::{Path, PathBuf};

use clap::{Subcommand, ValueEnum};
use clap_complete::{generate, shells};
use clap_mangen::Man;

use super::common::output::print;
use packwatch_host::failure::Failure;

/// Text of the main page that follows the part generated from the command line.
const MAIN_PAGE: &str = "\
.SH EXIT STATUS
0: success. 1: failure. 2: wrong command line. 78: wrong configuration. A command with further codes lists them.
.SH FILES
.TP
.I /etc/packwatch/packwatch.toml
Configuration of the service.
.TP
.I /var/lib/packwatch
Its state and history.
.TP
.I /run/packwatch
Its sockets.
.TP
.I /usr/share/packwatch/packwatch.dbc
The frames it sends by default; \\fBpackwatch dbc\\fR writes the configured ones.
.SH SEE ALSO
.BR packwatch.toml (5)
";

/// Arguments of `generate`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    what: GenerateCommand,
}

#[derive(Debug, Subcommand)]
enum GenerateCommand {
    /// Write the manual pages of every command and of the configuration into a folder, which is created
    Man {
        /// Folder to write to
        #[arg(value_name = "DIR")]
        folder: PathBuf,
    },
    /// Print the completions for a shell
    Completions {
        /// Shell to complete for
        shell: Shell,
    },
}

/// Common shells on Linux. Completions for other shells would only enlarge the program on the vehicle.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Shell {
    Bash,
    Zsh,
    Fish,
}

/// Runs the command; `all` is the definition of the whole command line.
pub(crate) fn run(args: &Args, all: &clap::Command) -> Result<(), Failure> {
    match &args.what {
        GenerateCommand::Man { folder } => write_all(folder, &manual_pages(all)),
        GenerateCommand::Completions { shell } => print(&String::from_utf8_lossy(&completions(*shell, all))),
    }
}

/// Definition of the command line without hidden commands.
fn visible(all: &clap::Command) -> clap::Command {
    let shown = all.get_subcommands().filter(|command| !command.is_hide_set()).cloned();
    let mut command = clap::Command::new("packwatch").propagate_version(true).subcommands(shown);
    command = command.args(all.get_arguments().cloned());
    command = command.version(env!("CARGO_PKG_VERSION")).disable_help_subcommand(true);
    if let Some(about) = all.get_about() {
        command = command.about(about.clone());
    }
    command.build();
    command
}

/// Returns file name and text of each page.
fn manual_pages(all: &clap::Command) -> Vec<(String, Vec<u8>)> {
    let command = visible(all);
    let mut pages = vec![("packwatch.toml.5".to_owned(), crate::config::manual().into_bytes())];
    add_pages(&command, &mut pages);
    pages
}

/// Adds the page of a command, then the pages of its subcommands.
fn add_pages(command: &clap::Command, pages: &mut Vec<(String, Vec<u8>)>) {
    pages.push(page(command));
    for own in command.get_subcommands().filter(|own| !own.is_hide_set()) {
        add_pages(own, pages);
    }
}

fn page(command: &clap::Command) -> (String, Vec<u8>) {
    let man = Man::new(command.clone()).manual("packwatch").source(concat!("packwatch ", env!("CARGO_PKG_VERSION")));
    let (name, mut text) = (man.get_filename(), Vec::new());
    // Writing to a Vec cannot fail.
    let _ = man.render(&mut text);
    let is_whole = command.get_name() == "packwatch";
    let more = if is_whole { MAIN_PAGE } else { ".SH SEE ALSO\n.BR packwatch (1),\n.BR packwatch.toml (5)\n" };
    text.extend_from_slice(more.as_bytes());
    (name, text)
}

fn completions(shell: Shell, all: &clap::Command) -> Vec<u8> {
    let (mut command, mut text) = (visible(all), Vec::new());
    match shell {
        Shell::Bash => generate(shells::Bash, &mut command, "packwatch", &mut text),
        Shell::Zsh => generate(shells::Zsh, &mut command, "packwatch", &mut text),
        Shell::Fish => generate(shells::Fish, &mut command, "packwatch", &mut text),
    }
    text
}

fn write_all(folder: &Path, pages: &[(String, Vec<u8>)]) -> Result<(), Failure> {
    let fault = |path: &Path, error| Failure::new(format!("{}: cannot be written: {error}", path.display()));
    std::fs::create_dir_all(folder).map_err(|error| fault(folder, error))?;
    for (name, text) in pages {
        let path = folder.join(name);
        std::fs::write(&path, text).map_err(|error| fault(&path, error))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
