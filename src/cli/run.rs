//! `packwatch run`: runs the service on live CAN interfaces.

use std::path::PathBuf;
use std::time::Duration;

use super::common::numbers::{MAX_SECONDS, away, between, bytes, whole};
use super::common::output::failure;
use crate::config;
use crate::io::can_key::CanKey;
use crate::io::place::PlaceSetting;
use crate::io::segments::{DEFAULT_SEGMENT_BYTES, SegmentLimits};
use crate::io::snapshot_file;
use crate::io::socket::DEFAULT_RECEIVE_BUFFER_BYTES;
use crate::monitor::Downtime;
use crate::service::readiness::{DEFAULT_READY_TIMEOUT_S, MAX_READY_TIMEOUT_S};
use crate::status::document::ConfigFile;
use crate::{logging, service::Service};
use packwatch_host::failure::Failure;

/// Arguments of `run`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Configuration file
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
    /// Record every input in this journal, for `packwatch replay`; rename an existing FILE to FILE.1
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Limit the journal to SIZE, for example 2GiB: record in compressed segments FILE.000001.zst, FILE.000002.zst and so on,
    /// and delete the oldest, including those of the previous run
    #[arg(long, value_name = "SIZE", requires = "record", value_parser = bytes)]
    record_limit: Option<u64>,
    /// Size of a segment [default: 64MiB]
    #[arg(long, value_name = "SIZE", requires = "record_limit", value_parser = bytes, default_value_t = DEFAULT_SEGMENT_BYTES, hide_default_value = true)]
    record_segment: u64,
    /// Log the sent frames in candump format, each with the time of the input that caused it
    #[arg(long, value_name = "FILE")]
    frames: Option<PathBuf>,
    /// Write events as JSON lines, as `packwatch replay --events` does
    #[arg(long, value_name = "FILE")]
    events: Option<PathBuf>,
    /// Start from the state in this file, which --snapshot has written
    #[arg(long, value_name = "FILE")]
    restore: Option<PathBuf>,
    /// Time since the restored state was written. Needed only if the state came from a replayed log: the time stamp in
    /// the state is then the log's time and does not give the age
    #[arg(long, value_name = "SECONDS|unknown", requires = "restore", value_parser = away)]
    away: Option<Downtime>,
    /// Folder for state and history; `none` keeps nothing [default: $STATE_DIRECTORY under systemd, else
    /// $XDG_STATE_HOME/packwatch or ~/.local/state/packwatch]. The state found there is restored, unless --restore is given
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
    /// Write the state to this file on stopping, for --restore
    #[arg(long, value_name = "FILE")]
    snapshot: Option<PathBuf>,
    /// Stop after this time
    #[arg(long = "for", value_name = "SECONDS", value_parser = between(0.0, MAX_SECONDS, "seconds, "))]
    duration: Option<f64>,
    /// Wait at most this long for the first usable frame before reporting readiness to the service manager
    #[arg(long, value_name = "SECONDS", default_value_t = DEFAULT_READY_TIMEOUT_S, value_parser = between(0.0, MAX_READY_TIMEOUT_S, "seconds, "))]
    ready_timeout: f64,
    /// Log level or filter: error, warn, info, debug, trace [default: $PACKWATCH_LOG, else info]
    #[arg(long, value_name = "LEVEL")]
    log: Option<String>,
    /// Receive buffer to request from the kernel for each interface
    #[arg(long, value_name = "BYTES", default_value_t = DEFAULT_RECEIVE_BUFFER_BYTES, value_parser = whole::<0, MAX_BUFFER_BYTES>)]
    receive_buffer: usize,
    /// Socket for `packwatch alarms` and other commands; `none` creates no socket [default: $RUNTIME_DIRECTORY/control.sock
    /// under systemd, else in /run/packwatch for root and in $XDG_RUNTIME_DIR/packwatch for others]
    #[arg(long, value_name = "PATH")]
    control: Option<PathBuf>,
    /// Socket for `packwatch status` and the exporter; `none` creates no socket. The socket for `status --watch` is next to
    /// it [default: $RUNTIME_DIRECTORY/status.sock under systemd, else in /run/packwatch for root and in
    /// $XDG_RUNTIME_DIR/packwatch for others]
    #[arg(long, value_name = "PATH")]
    status: Option<PathBuf>,
}

/// Largest receive buffer (bytes): half of the kernel's limit, because the kernel doubles the requested size.
const MAX_BUFFER_BYTES: usize = (i32::MAX / 2) as usize;

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    logging::start(args.log.as_deref()).map_err(Failure::new)?;
    let record_limits = args.record_limit.map(|total| SegmentLimits::new(total, args.record_segment)).transpose();
    let config = config::load(&args.config)?;
    let key = config.key.as_ref().map(|key| CanKey::load(key, std::env::var_os("CREDENTIALS_DIRECTORY"))).transpose();
    let service = Service {
        key: key.map_err(Failure::config)?,
        config,
        record: args.record.clone(),
        record_limits: record_limits
            .map_err(|why| Failure::new(format!("--record-limit: {why} (--record-segment)")))?,
        frames: args.frames.clone(),
        events: args.events.clone(),
        restore: args.restore.as_deref().map(snapshot_file::read).transpose().map_err(Failure::new)?,
        downtime: args.away.unwrap_or_default(),
        snapshot: args.snapshot.clone(),
        duration: args.duration.map(Duration::from_secs_f64),
        ready_timeout: Duration::from_secs_f64(args.ready_timeout),
        receive_buffer_bytes: args.receive_buffer,
        state: PlaceSetting::from_path(args.state.clone()),
        control: PlaceSetting::from_path(args.control.clone()),
        status: PlaceSetting::from_path(args.status.clone()),
        config_file: ConfigFile::of(&args.config),
    };
    service.run().map_err(failure)
}
