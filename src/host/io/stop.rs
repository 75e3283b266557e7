//! Waits for a set time, or for a signal that would otherwise end the process, so that a program can stop cleanly.

use std::future::poll_fn;
use std::io;
use std::task::Poll;
use std::time::Duration;

use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::oneshot;
use tokio::time::{Instant, sleep_until};

/// Numbers of further signals that end a process by default, without the signals of crashes: SIGQUIT, SIGUSR1, SIGUSR2,
/// SIGALRM, SIGSTKFLT, SIGXCPU, SIGVTALRM, SIGPROF, SIGIO, SIGPWR (Linux, except MIPS) and the real-time signals. The C
/// library reserves the first real-time signals: they cannot be caught and are skipped.
const OTHERS: [std::ops::RangeInclusive<i32>; 9] =
    [3..=3, 10..=10, 12..=12, 14..=14, 16..=16, 24..=24, 26..=27, 29..=30, 34..=64];
/// SIGXFSZ. If it is caught, a write that exceeds the limit fails like any other write, and the daemon continues.
const FILE_SIZE: i32 = 25;

/// Waits for the signal or time that ends the loop.
#[derive(Debug)]
pub struct Stop {
    signalled: oneshot::Receiver<i32>,
    at: Option<Instant>,
}

impl Stop {
    /// Catches the signals. Must be called inside the tokio runtime.
    pub fn new(duration: Option<Duration>) -> io::Result<Self> {
        let catch = |kind: SignalKind| signal(kind).map(|caught| (kind.as_raw_value(), caught));
        let mut signals = vec![catch(SignalKind::terminate())?, catch(SignalKind::interrupt())?];
        let others = OTHERS.into_iter().flatten();
        signals.extend(others.filter_map(|number| catch(SignalKind::from_raw(number)).ok()));
        let _ = signal(SignalKind::from_raw(FILE_SIZE));
        let (sender, signalled) = oneshot::channel();
        // A separate task waits for all signals, so the caller polls one receiver instead of about 40.
        tokio::spawn(async move { sender.send(first(signals).await) });
        Ok(Self { signalled, at: duration.map(|duration| Instant::now() + duration) })
    }

    /// Waits for a signal or for the end of the duration. Must not be called again after it has returned.
    pub async fn wait(&mut self) {
        let at = self.at;
        let timer = async move {
            match at {
                Some(at) => sleep_until(at).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            number = &mut self.signalled => {
                if let Ok(number) = number {
                    tracing::info!(number, "stopping after a signal");
                }
            }
            () = timer => {}
        }
    }
}

async fn first(mut signals: Vec<(i32, Signal)>) -> i32 {
    poll_fn(|context| {
        let mut caught =
            signals.iter_mut().filter_map(|(number, signal)| signal.poll_recv(context).is_ready().then_some(*number));
        caught.next().map_or(Poll::Pending, Poll::Ready)
    })
    .await
}
