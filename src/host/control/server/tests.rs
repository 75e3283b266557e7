//! Tests the control socket with well-behaved and misbehaving clients. Each client is answered or dropped, and no
//! client blocks the daemon's loop or another client.

use std::path::{Path, PathBuf};

use tempfile::TempDir;
use tokio::io::AsyncRead;

use super::super::MAX_CONNECTIONS;
use super::super::protocol::{CommandOutcome, contents};
use super::*;
use crate::monitor::Command;
use crate::quantity::Timestamp;

fn block_on(test: impl Future<Output = ()>) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(test);
}

fn done(changed: u32) -> Answer {
    Answer::Outcome(CommandOutcome {
        time: Timestamp::ZERO,
        changed,
        refused: 0,
        refused_alarms: Vec::new(),
        is_stored: None,
    })
}

/// Starts a server, and a loop that answers every request with the number of requests received so far.
async fn serve(folder: &TempDir) -> (ControlServer, PathBuf) {
    serve_patiently(folder, MAX_SILENCE).await
}

async fn serve_patiently(folder: &TempDir, max_silence: Duration) -> (ControlServer, PathBuf) {
    let path = folder.path().join("control.sock");
    let (sender, mut requests) = mpsc::channel::<PendingRequest>(MAX_CONNECTIONS);
    tokio::spawn(async move {
        let mut count = 0;
        while let Some(pending) = requests.recv().await {
            count += 1;
            let _ = pending.answer.send(done(count));
        }
    });
    let bound = bind(&path, MODE).await.map_err(|error| format!("{error:?}")).unwrap();
    (ControlServer::serve(bound, sender, max_silence).unwrap(), path)
}

async fn connect(path: &Path) -> UnixStream {
    UnixStream::connect(path).await.unwrap()
}

async fn line(stream: &mut (impl AsyncRead + Unpin)) -> String {
    let mut line = Vec::new();
    BufReader::new(stream).read_until(b'\n', &mut line).await.unwrap();
    String::from_utf8(line).unwrap()
}

const REPLACED: Request = Request::Command(Command::PackReplaced);

#[test]
fn requests_are_answered_in_order() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let (_server, path) = serve(&folder).await;
        let mut client = connect(&path).await;
        for count in 1..4 {
            client.write_all(REPLACED.to_line().as_bytes()).await.unwrap();
            let done: CommandOutcome = contents(line(&mut client).await.as_bytes()).unwrap();
            assert_eq!(done.changed, count);
        }
        client.write_all(b"rubbish\n").await.unwrap();
        assert!(line(&mut client).await.contains("not a JSON document"));
        client.write_all(REPLACED.to_line().as_bytes()).await.unwrap();
        assert!(line(&mut client).await.contains("\"changed\":4"), "the server must answer after an invalid request");
    });
}

#[test]
fn overlong_request_ends_connection() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let (_server, path) = serve(&folder).await;
        let mut client = connect(&path).await;
        client.write_all(&[b' '; MAX_REQUEST_BYTES + 1]).await.unwrap();
        assert!(line(&mut client).await.contains("at most 4096 bytes"));
        assert_eq!(line(&mut client).await, "");
        // The longest allowed request is answered.
        let mut longest = REPLACED.to_line().into_bytes();
        longest.splice(0..0, std::iter::repeat_n(b' ', MAX_REQUEST_BYTES - longest.len()));
        let mut client = connect(&path).await;
        client.write_all(&longest).await.unwrap();
        assert!(line(&mut client).await.contains("\"changed\":1"));
    });
}

#[test]
fn silent_client_is_dropped() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        // The test uses real sockets, which need real time.
        let max_silence = Duration::from_millis(200);
        let (_server, path) = serve_patiently(&folder, max_silence).await;
        let mut client = connect(&path).await;
        let began = tokio::time::Instant::now();
        client.write_all(b"{\"version\"").await.unwrap();
        assert!(line(&mut client).await.contains("no request within 0.2 s"));
        let waited = began.elapsed();
        assert!(waited >= max_silence, "{waited:?}");
        assert_eq!(line(&mut client).await, "");
    });
}

#[test]
fn client_that_never_reads_is_dropped() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let (_server, path) = serve_patiently(&folder, Duration::from_millis(200)).await;
        let deaf = connect(&path).await;
        let flood = REPLACED.to_line().repeat(100);
        let mut client = connect(&path).await;
        let mut served = 0;
        // The loop ends when a write fails because the server has closed the connection.
        loop {
            match deaf.try_write(flood.as_bytes()) {
                Err(error) if error.kind() != std::io::ErrorKind::WouldBlock => break,
                Ok(_) | Err(_) => {}
            }
            client.write_all(REPLACED.to_line().as_bytes()).await.unwrap();
            assert!(
                line(&mut client).await.contains("\"ok\":true"),
                "the server must answer while another client is silent"
            );
            served += 1;
        }
        assert!(served > 0);
    });
}

#[test]
fn request_displaces_silent_clients() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let (_server, path) = serve(&folder).await;
        let mut silent = Vec::new();
        // All connections of this process count as one client.
        for _ in 0..super::SLOTS.per_client {
            silent.push(connect(&path).await);
        }
        let mut next = connect(&path).await;
        let refused = line(&mut next).await;
        assert!(refused.contains("\"ok\":false") && refused.contains("try again later"), "{refused}");
        tokio::time::sleep(crate::io::connection_slots::GRACE).await;
        let began = tokio::time::Instant::now();
        let mut next = connect(&path).await;
        next.write_all(REPLACED.to_line().as_bytes()).await.unwrap();
        assert!(line(&mut next).await.contains("\"ok\":true"));
        assert!(began.elapsed() < MAX_SILENCE / 10, "{:?}", began.elapsed());
        assert_eq!(line(&mut silent[0]).await, "", "the connection that was silent longest is closed");
    });
}

#[test]
fn only_dead_daemons_socket_is_replaced() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("control.sock");
        drop(std::os::unix::net::UnixListener::bind(&path).unwrap());
        assert!(path.exists(), "the test needs the socket file of a dead daemon");
        let (server, path) = serve(&folder).await;
        let (sender, _requests) = mpsc::channel(1);
        let second = ControlServer::start(&PlaceSetting::At(path.clone()), sender).await.unwrap_err();
        let own = format!("process {} of user", std::process::id());
        assert!(second.contains("control.sock") && second.contains(&own), "{second}");
        use std::os::unix::fs::PermissionsExt as _;
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o660);
        drop(server);
        assert!(!path.exists(), "the server must delete its socket file when it ends");
    });
}

#[test]
fn file_that_is_not_a_socket_is_kept() {
    block_on(async {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("control.sock");
        std::fs::write(&path, "mine").unwrap();
        let (sender, _requests) = mpsc::channel(1);
        let error = ControlServer::start(&PlaceSetting::At(path.clone()), sender.clone()).await.unwrap_err();
        assert!(error.ends_with("exists and is not a socket"), "{error}");
        assert_eq!(std::fs::read(&path).unwrap(), b"mine");
        assert!(ControlServer::start(&PlaceSetting::Off, sender).await.unwrap().is_none());
    });
}
