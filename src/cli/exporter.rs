//! `packwatch exporter`: serves the status of the running daemon as metrics over HTTP.

use std::net::SocketAddr;
use std::path::PathBuf;

use crate::status::standard_path;
use crate::{exporter, logging};
use packwatch_host::failure::Failure;

/// Arguments of `exporter`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Address to listen on; the default accepts connections from this computer only
    #[arg(long, value_name = "ADDR:PORT", default_value = "127.0.0.1:9558", value_parser = address)]
    listen: SocketAddr,
    /// Status socket of the daemon [default: where `packwatch run` creates it]
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
    /// Log level or filter: error, warn, info, debug, trace [default: $PACKWATCH_LOG, else info]
    #[arg(long, value_name = "LEVEL")]
    log: Option<String>,
}

fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| "must be a numeric address and a port, for example 127.0.0.1:9558 or [::]:9558".to_owned())
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    logging::start(args.log.as_deref()).map_err(Failure::new)?;
    exporter::run(args.listen, args.socket.clone().unwrap_or_else(standard_path)).map_err(Failure::new)
}
