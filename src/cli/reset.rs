//! `packwatch reset`: forgets the learned values, through the running daemon or, without one, in its store.

use std::path::PathBuf;

use super::common::control::{ControlArgs, replace_pack};
use super::common::output::print;
use crate::store;
use packwatch_host::failure::Failure;

/// Arguments of `reset`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Another pack is connected: starts its history and forgets the learned values of the old one
    #[arg(long, required = true)]
    pack_replaced: bool,
    /// Confirms it
    #[arg(long)]
    yes: bool,
    /// Folder of state and history, for when no daemon runs (default: $STATE_DIRECTORY, else /var/lib/packwatch, or where there is none, that of a daemon from a shell)
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
    #[command(flatten)]
    control: ControlArgs,
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let client = args.control.client();
    if !args.yes || client.is_served() {
        return replace_pack(args.yes, &client);
    }
    let folder = args.state.clone().unwrap_or_else(store::standard_folder);
    let pack = store::replace_pack(&folder).map_err(Failure::new)?;
    print(&format!(
        "no daemon runs: in {} the history of pack {} is closed, that of pack {pack} starts; the stored state, with its \
         alarms, is forgotten\n",
        folder.display(),
        pack - 1
    ))
}
