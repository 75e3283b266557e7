//! Receives the daemon's status, one document a second, as a watched value. A reader that is slower than the daemon gets
//! only the newest document.

use std::path::Path;

use packwatch_host::status::client::parse;
use packwatch_host::status::document::StatusDocument;
use tokio::sync::watch;

/// The newest document, as a watched value; `None` = the daemon is silent.
pub type Documents = watch::Receiver<Option<Box<StatusDocument>>>;

/// Reads the stream that belongs to the status socket `socket`, in a task of the current runtime, until the last
/// receiver is dropped.
pub fn follow(socket: &Path) -> Documents {
    let (sender, receiver) = watch::channel(None);
    let socket = socket.to_owned();
    tokio::spawn(async move {
        let handle = |line: Result<&[u8], &str>| {
            match line {
                Ok(line) => drop(sender.send_replace(Some(Box::new(parse(line)?)))),
                Err(_) => drop(sender.send_if_modified(|document| document.take().is_some())),
            }
            Ok(())
        };
        let setting = "the key status.socket of the settings file";
        tokio::select! {
            () = packwatch_host::status::stream::follow(&socket, setting, handle) => {}
            () = sender.closed() => {}
        }
    });
    receiver
}
