//! `packwatch exporter`: serves the status of the running daemon over HTTP, as metrics and as a live page.

use std::net::SocketAddr;
use std::path::PathBuf;

use crate::status::standard_path;
use crate::{exporter, logging};
use packwatch_host::failure::Failure;

/// Arguments of `exporter`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Address to listen on; the default accepts connections from this computer only. On another address, the live page
    /// needs a token
    #[arg(long, value_name = "ADDR:PORT", default_value = "127.0.0.1:9558", value_parser = address)]
    listen: SocketAddr,
    /// Status socket of the daemon [default: where `packwatch run` creates it]
    #[arg(long, value_name = "PATH")]
    socket: Option<PathBuf>,
    /// File with the token that every client must send [default: the credential exporter-token of the unit, if it exists]
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Log level or filter: error, warn, info, debug, trace [default: $PACKWATCH_LOG, else info]
    #[arg(long, value_name = "LEVEL")]
    log: Option<String>,
}

#[cfg(feature = "lab")]
const REPORT: exporter::ReportMaker = Some(super::report::page_of_store);
#[cfg(not(feature = "lab"))]
const REPORT: exporter::ReportMaker = None;

fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| "must be a numeric address and a port, for example 127.0.0.1:9558 or [::]:9558".to_owned())
}

/// The token's file among the unit's credentials (`LoadCredential=`), if there is one.
fn credential() -> Option<PathBuf> {
    let folder = PathBuf::from(std::env::var_os("CREDENTIALS_DIRECTORY")?);
    Some(folder.join("exporter-token")).filter(|file| file.exists())
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    logging::start(args.log.as_deref()).map_err(Failure::new)?;
    let socket = args.socket.clone().unwrap_or_else(standard_path);
    let token_file = args.token_file.clone().or_else(credential);
    exporter::run(args.listen, &socket, token_file.as_deref(), REPORT).map_err(Failure::new)
}
