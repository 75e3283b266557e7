//! The full-screen live view of `packwatch status --watch`: the terminal, and the loop around [`App`].
//!
//! Input: documents of the stream socket, keys, the clock. Output: a screen, which is redrawn on each input. The
//! terminal is restored when the user quits, on SIGTERM, SIGINT and SIGHUP, and on a panic. If the daemon stops, the
//! view waits until the daemon returns.

mod app;
mod draw;
mod feed;
mod pages;
mod plot;
mod theme;

use std::io::{self, IsTerminal};
use std::path::Path;
use std::time::Duration;

use packwatch_host::io::runtime::new_runtime;
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tokio::time::interval;

use app::App;

/// Longest time between redraws. It limits how long a stale document stays on the screen.
const DRAW_PERIOD: Duration = Duration::from_secs(1);
/// Capacity of the key queue: more than a user types between two redraws.
const KEYS: usize = 64;

/// Runs the view until the user quits. `socket` is the status socket; the stream socket is in the same folder.
///
/// # Errors
/// Fails if there is no terminal, or if the terminal fails.
pub(super) fn run(socket: &Path) -> Result<(), String> {
    if !io::stdout().is_terminal() || !io::stdin().is_terminal() {
        return Err(
            "--watch needs a terminal as standard input and output; run without --watch for a table, or with --json for a \
            document"
                .to_owned(),
        );
    }
    // If NO_COLOR is set and not empty, the view has no colours (https://no-color.org).
    let has_colour = std::env::var_os("NO_COLOR").is_none_or(|value| value.is_empty());
    let app = App::new(socket.to_owned(), has_colour);
    let runtime = new_runtime().map_err(|error| format!("cannot start: {error}"))?;
    // After this call, a panic also restores the terminal.
    let terminal = ratatui::try_init().map_err(|error| format!("terminal: {error}"))?;
    let watched = runtime.block_on(watch(terminal, app));
    ratatui::restore();
    // The thread that waits for keys ends with the process.
    runtime.shutdown_background();
    watched.map_err(|error| format!("terminal: {error}"))
}

async fn watch(mut terminal: DefaultTerminal, mut app: App) -> io::Result<()> {
    let kinds = [SignalKind::terminate(), SignalKind::interrupt(), SignalKind::hangup()];
    let [terminate, interrupt, hangup] = kinds.map(signal);
    let (mut terminate, mut interrupt, mut hangup) = (terminate?, interrupt?, hangup?);
    let mut keys = read_keys()?;
    let mut updates = feed::start(app.path().to_owned());
    let mut ticks = interval(DRAW_PERIOD);
    loop {
        tokio::select! {
            _ = terminate.recv() => return Ok(()),
            _ = interrupt.recv() => return Ok(()),
            _ = hangup.recv() => return Ok(()),
            key = keys.recv() => match key {
                Some(Event::Key(key)) => match meaning(key) {
                    Some(KeyCode::Esc) => return Ok(()),
                    Some(key) => app.handle_key(key),
                    None => continue,
                },
                // For example, the terminal was resized: redraw.
                Some(_) => {}
                // The terminal was closed.
                None => return Ok(()),
            },
            Some(update) = updates.recv() => app.handle_update(update),
            _ = ticks.tick() => {}
        }
        app.poll(feed::now());
        terminal.draw(|frame| draw::draw(frame, &mut app))?;
    }
}

fn read_keys() -> io::Result<mpsc::Receiver<Event>> {
    let (sender, keys) = mpsc::channel(KEYS);
    std::thread::Builder::new().name("keys".to_owned()).spawn(move || {
        while let Ok(event) = event::read() {
            if sender.blocking_send(event).is_err() {
                return;
            }
        }
    })?;
    Ok(keys)
}

/// Maps a key to the key that the view handles. Every key that quits gives Esc; an unknown key gives `None`.
fn meaning(key: KeyEvent) -> Option<KeyCode> {
    let has_control = key.modifiers.contains(KeyModifiers::CONTROL);
    match key.code {
        _ if key.kind == KeyEventKind::Release => None,
        KeyCode::Char('c') if has_control => Some(KeyCode::Esc),
        _ if has_control => None,
        KeyCode::Char('q') => Some(KeyCode::Esc),
        KeyCode::Char(letter) if letter != 'v' => None,
        code => Some(code),
    }
}

#[cfg(test)]
mod tests;
