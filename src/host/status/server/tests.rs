//! Tests the status sockets with real sockets in real time.

use std::io::Read;
use std::os::unix::net::UnixStream;
use std::path::Path;

use tempfile::TempDir;

use super::super::client::{StatusClient, parse};
use super::super::sample::sample;
use super::*;

const PATIENT: Limits = Limits { max_silence: Duration::from_secs(5), stale: Duration::from_secs(3) };

fn serve(folder: &TempDir, limits: Limits) -> (StatusServer, PathBuf) {
    let path = folder.path().join("status.sock");
    let server = StatusServer::open(path.clone(), limits).map_err(|error| format!("{error:?}")).unwrap();
    (server, path)
}

fn draft(cells: u16, pid: u32) -> Draft {
    Draft { document: StatusDocument { pid, events: Vec::new(), ..sample(cells) }, events: Vec::new() }
}

/// Offers drafts until the thread accepts one.
fn offer(server: &StatusServer, cells: u16, pid: u32) {
    while !server.offer(draft(cells, pid)) {
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn connect(path: &Path) -> UnixStream {
    let stream = UnixStream::connect(path).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    stream
}

fn rest(mut stream: UnixStream) -> Vec<u8> {
    let mut all = Vec::new();
    let _ = stream.read_to_end(&mut all);
    all
}

fn until(what: &str, mut is_so: impl FnMut() -> bool) {
    let begun = std::time::Instant::now();
    while !is_so() {
        assert!(begun.elapsed() < Duration::from_secs(10), "never {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn client_receives_one_document_then_eof() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = serve(&folder, PATIENT);
    // The client connects before there is a document, and waits for the first document.
    let early = connect(&path);
    offer(&server, 96, 1);
    let received = parse(&rest(early)).unwrap();
    assert_eq!(received, StatusDocument { pid: 1, events: Vec::new(), ..sample(96) });
    let line = StatusClient::new(Some(&path)).line().unwrap();
    assert_eq!(parse(&line).unwrap(), received);
    assert_eq!(server.clients().served, 2);
    drop(server);
    assert!(!path.exists() && !stream_path(&path).exists(), "the server must delete its sockets");
    assert!(StatusClient::new(Some(&path)).line().unwrap_err().contains("no daemon listens there"));
    std::fs::write(&path, "a file").unwrap();
    let expected = "status.sock: is a regular file, must be the status socket of a daemon; give its path with --socket";
    assert!(StatusClient::new(Some(&path)).line().unwrap_err().ends_with(expected));
}

#[test]
fn stream_sends_a_line_per_document() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = serve(&folder, PATIENT);
    let mut stream = std::io::BufReader::new(connect(&stream_path(&path)));
    until("connected", || server.clients().connected == 1);
    for pid in 1..4 {
        offer(&server, 1, pid);
        let mut line = String::new();
        std::io::BufRead::read_line(&mut stream, &mut line).unwrap();
        assert_eq!(parse(line.as_bytes()).unwrap().pid, pid);
    }
    drop(stream);
    offer(&server, 1, 4);
    offer(&server, 1, 5);
    until("the client's end is seen", || server.clients().connected == 0);
    assert_eq!(server.clients().dropped, 0);
}

#[test]
fn clients_beyond_limit_of_process_are_rejected_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = serve(&folder, PATIENT);
    let seated: Vec<UnixStream> = (0..SLOTS.per_client).map(|_| connect(&stream_path(&path))).collect();
    until("full", || server.clients().connected == SLOTS.per_client as u64);
    for _ in 0..136 {
        assert_eq!(rest(connect(&path)), b"");
    }
    assert_eq!((server.clients().served, server.clients().refused), (SLOTS.per_client as u64, 136));
    offer(&server, 1, 7);
    for mut stream in seated {
        assert_ne!(stream.read(&mut [0; 16]).unwrap(), 0, "the server must serve an admitted client");
    }
    // The clients that were served have closed their connections, so there is room again.
    until("room", || {
        offer(&server, 1, 8);
        server.clients().connected == 0
    });
    assert!(!rest(connect(&path)).is_empty());
}

#[test]
fn client_that_never_reads_is_dropped() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = serve(&folder, Limits { max_silence: Duration::from_millis(300), ..PATIENT });
    let deaf = [connect(&path), connect(&stream_path(&path))];
    until("connected", || server.clients().connected == 2);
    // The server sends more than a socket's buffer can hold.
    let mut pid = 0;
    until("both are dropped", || {
        pid += 1;
        offer(&server, 1024, pid);
        assert!(parse(&rest(connect(&path))).is_ok(), "the server must serve while another client is silent");
        server.clients().dropped == 2
    });
    drop(deaf);
}

#[test]
fn stale_document_is_not_served() {
    let folder = tempfile::tempdir().unwrap();
    let stale = Duration::from_millis(100);
    let (server, path) = serve(&folder, Limits { max_silence: Duration::from_millis(300), stale });
    offer(&server, 1, 1);
    assert!(!rest(connect(&path)).is_empty());
    std::thread::sleep(stale);
    assert_eq!(rest(connect(&path)), b"", "the server must not send a stale document");
    offer(&server, 1, 2);
    assert!(!rest(connect(&path)).is_empty());
}

#[test]
fn second_daemon_cannot_take_the_sockets() {
    let folder = tempfile::tempdir().unwrap();
    let (_server, path) = serve(&folder, PATIENT);
    let error = StatusServer::start(&PlaceSetting::At(path)).unwrap_err();
    assert!(error.contains("already in use by") && error.contains("--status"), "{error}");
}

#[test]
fn offer_never_blocks() {
    let folder = tempfile::tempdir().unwrap();
    let (server, _path) = serve(&folder, PATIENT);
    // The thread needs milliseconds to serialise 1,024 cells. Offers come faster, so some offers must be rejected.
    let taken = (0..200).filter(|pid| server.offer(draft(1024, *pid))).count();
    assert!((1..200).contains(&taken), "{taken} of 200 taken");
}
