//! `packwatch reset`: discards the learned values through the running daemon or, if none runs, directly in the store.

use std::path::PathBuf;

use super::common::control::{ControlArgs, replace_pack};
use super::common::output::print;
use crate::store;
use packwatch_host::failure::Failure;

/// Arguments of `reset`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Discard the learned values and close the history of the old pack, because another pack is connected
    #[arg(long, required = true)]
    pack_replaced: bool,
    /// Confirm that the learned values are discarded
    #[arg(long)]
    yes: bool,
    /// Folder of state and history, used if no daemon runs [default: $STATE_DIRECTORY, else /var/lib/packwatch, else the
    /// user's folder that `packwatch run` uses]
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
        "no daemon runs. {}: closed the history of pack {}, started the history of pack {pack}; discarded the stored \
        state with its alarms\n",
        folder.display(),
        pack - 1
    ))
}
