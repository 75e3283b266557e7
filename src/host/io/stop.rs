//! Ends the daemon's loop on SIGTERM, on SIGINT, or after a set time.

use std::io;
use std::time::Duration;

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::time::{Instant, sleep_until};

/// Waits for the signal or time that ends the loop.
#[derive(Debug)]
pub struct Stop {
    terminate: Signal,
    interrupt: Signal,
    at: Option<Instant>,
}

impl Stop {
    pub fn new(duration: Option<Duration>) -> io::Result<Self> {
        Ok(Self {
            terminate: signal(SignalKind::terminate())?,
            interrupt: signal(SignalKind::interrupt())?,
            at: duration.map(|duration| Instant::now() + duration),
        })
    }

    pub async fn wait(&mut self) {
        let at = self.at;
        let timer = async move {
            match at {
                Some(at) => sleep_until(at).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            _ = self.terminate.recv() => {}
            _ = self.interrupt.recv() => {}
            () = timer => {}
        }
    }
}
