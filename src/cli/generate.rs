//! `packwatch generate`: manual pages and shell completions, from the definition of the command line. Hidden: it is for
//! building a package.

use std::path::{Path, PathBuf};

use clap::{CommandFactory, Subcommand, ValueEnum};
use clap_complete::{generate, shells};
use clap_mangen::Man;

use super::output::print;
use super::{Cli, Failure};

/// Name of the manual page about configurations.
const CONFIGURATION_PAGE: &str = "packwatch.toml.5";

/// Text of the main page besides the definition of the command line.
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
        /// The folder
        #[arg(value_name = "DIR")]
        folder: PathBuf,
    },
    /// Print the completions of a shell
    Completions {
        /// The shell
        shell: Shell,
    },
}

/// Shells of Linux: the generators of others would be code in the vehicle for nothing.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Shell {
    Bash,
    Zsh,
    Fish,
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.what {
        GenerateCommand::Man { folder } => write_all(folder, &manual_pages()),
        GenerateCommand::Completions { shell } => print(&String::from_utf8_lossy(&completions(*shell))),
    }
}

/// The command line without hidden commands.
fn visible() -> clap::Command {
    let all = Cli::command();
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

/// File name and text of each page.
fn manual_pages() -> Vec<(String, Vec<u8>)> {
    let command = visible();
    let mut pages = vec![(CONFIGURATION_PAGE.to_owned(), crate::config::manual().into_bytes())];
    add_pages(&command, &mut pages);
    pages
}

/// Adds the page of a command, then those of its subcommands.
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

fn completions(shell: Shell) -> Vec<u8> {
    let (mut command, mut text) = (visible(), Vec::new());
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
mod tests {
    use super::*;

    /// Names of all shown commands, each followed by its subcommands: `history`, `history-verify`.
    fn commands() -> Vec<String> {
        fn add(of: &clap::Command, before: &str, names: &mut Vec<String>) {
            for command in of.get_subcommands().filter(|command| !command.is_hide_set()) {
                let name = format!("{before}{}", command.get_name());
                names.push(name.clone());
                add(command, &format!("{name}-"), names);
            }
        }
        let mut names = Vec::new();
        add(&Cli::command(), "", &mut names);
        names
    }

    #[test]
    fn every_command_has_a_page_and_hidden_ones_have_none() {
        let names: Vec<String> = manual_pages().into_iter().map(|(name, _)| name).collect();
        let mut wanted = vec!["packwatch.toml.5".to_owned(), "packwatch.1".to_owned()];
        wanted.extend(commands().iter().map(|name| format!("packwatch-{name}.1")));
        assert_eq!(names, wanted);
        assert!(names.contains(&"packwatch-run.1".to_owned()) && !names.contains(&"packwatch-generate.1".to_owned()));
    }

    #[test]
    fn pages_show_the_usage_of_a_command_and_name_the_others() {
        let pages = manual_pages();
        let text = |name: &str| {
            let page = pages.iter().find(|(of, _)| of == name).map(|(_, text)| text.clone());
            String::from_utf8(page.unwrap_or_default()).unwrap_or_default()
        };
        let run = text("packwatch-run.1");
        assert!(run.contains("\\fBpackwatch run\\fR") && run.contains("\\-\\-config"), "{run}");
        let whole = text("packwatch.1");
        assert!(whole.contains("packwatch\\-alarms(1)") && !whole.contains("generate"), "{whole}");
        // In the order of man-pages(7), and not of itself.
        let files = whole.find(".SH FILES").unwrap_or(usize::MAX);
        assert!(
            whole.find(".SH SEE ALSO").is_some_and(|at| at > files) && !whole.contains(".BR packwatch (1)"),
            "{whole}"
        );
        assert!(run.contains(".BR packwatch (1)"), "{run}");
    }

    #[test]
    fn completions_know_every_command_and_nothing_hidden() {
        for shell in Shell::value_variants().iter().copied() {
            let text = String::from_utf8(completions(shell)).unwrap_or_default();
            for name in Cli::command().get_subcommands().filter(|c| !c.is_hide_set()).map(clap::Command::get_name) {
                assert!(text.contains(name), "{shell:?}: {name}");
            }
            assert!(!text.contains("generate "), "{shell:?}");
        }
    }
}
