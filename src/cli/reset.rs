//! `packwatch reset`: discards the learned values through the running daemon or, if none runs, directly in the store.

use std::path::PathBuf;

use super::common::control::{ControlArgs, replace_pack};
use super::common::output::print;
use crate::store::{self, ReplacedPack};
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

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let client = args.control.client();
    if !args.yes || client.is_served() {
        return replace_pack(args.yes, &client);
    }
    let folder = args.state.clone().unwrap_or_else(store::standard_folder);
    let ReplacedPack { next, damage } = store::replace_pack(&folder).map_err(Failure::new)?;
    let folder = folder.display();
    let damage = damage.map_or_else(String::new, |damage| format!("{folder}: the history was damaged: {damage}\n"));
    print(&format!(
        "{damage}no daemon runs. {folder}: closed the history of pack {}, started the history of pack {next}; discarded \
        the stored state with its alarms\n",
        next - 1
    ))
}
