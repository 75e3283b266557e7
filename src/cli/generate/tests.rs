//! Checks manual pages and completions against the command line.

use clap::CommandFactory as _;

use super::*;
use crate::cli::Cli;

/// Names of all visible commands, each followed by its subcommands: `history`, `history-verify`.
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
fn visible_commands_have_page_and_hidden_have_none() {
    let names: Vec<String> = manual_pages(&Cli::command()).into_iter().map(|(name, _)| name).collect();
    let mut wanted = vec!["packwatch.toml.5".to_owned(), "packwatch.1".to_owned()];
    wanted.extend(commands().iter().map(|name| format!("packwatch-{name}.1")));
    assert_eq!(names, wanted);
    assert!(names.contains(&"packwatch-run.1".to_owned()) && !names.contains(&"packwatch-generate.1".to_owned()));
}

#[test]
fn page_shows_usage_and_names_other_pages() {
    let pages = manual_pages(&Cli::command());
    let text = |name: &str| {
        let page = pages.iter().find(|(of, _)| of == name).map(|(_, text)| text.clone());
        String::from_utf8(page.unwrap_or_default()).unwrap_or_default()
    };
    let run = text("packwatch-run.1");
    assert!(run.contains("\\fBpackwatch run\\fR") && run.contains("\\-\\-config"), "{run}");
    let whole = text("packwatch.1");
    assert!(whole.contains("packwatch\\-alarms(1)") && !whole.contains("generate"), "{whole}");
    // The sections have the order of man-pages(7), and a page does not refer to itself.
    let files = whole.find(".SH FILES").unwrap_or(usize::MAX);
    assert!(whole.find(".SH SEE ALSO").is_some_and(|at| at > files) && !whole.contains(".BR packwatch (1)"), "{whole}");
    assert!(run.contains(".BR packwatch (1)"), "{run}");
}

#[test]
fn completions_list_visible_commands_only() {
    for shell in Shell::value_variants().iter().copied() {
        let text = String::from_utf8(completions(shell, &Cli::command())).unwrap_or_default();
        for name in Cli::command().get_subcommands().filter(|c| !c.is_hide_set()).map(clap::Command::get_name) {
            assert!(text.contains(name), "{shell:?}: {name}");
        }
        assert!(!text.contains("generate "), "{shell:?}");
    }
}
