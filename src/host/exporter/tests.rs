//! Tests the exporter: requests, access, and the page in a real browser.

mod browser;

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::os::unix::net::UnixListener;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, mpsc};
use std::thread;
use std::time::Duration;

use hyper::header::HeaderValue;
use tokio::net::TcpStream;
use tokio::time::sleep;

use super::*;
use crate::http::MAX_CONNECTIONS;
use crate::status::document::StatusDocument;
use crate::status::sample::sample;
use crate::status::stream_path;

fn site(token_file: Option<&Path>) -> Rc<Site> {
    let access = Access::new([127, 0, 0, 1].into(), token_file).unwrap();
    Rc::new(Site::new(access, None))
}

/// Starts an exporter in a thread. Returns its address, and the folder of the thread below `/proc`.
fn start_exporter(socket: &Path, token_file: Option<&Path>) -> (SocketAddr, PathBuf) {
    let (ready, address) = mpsc::channel();
    let (socket, token_file) = (socket.to_owned(), token_file.map(Path::to_owned));
    thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        LocalSet::new().block_on(&runtime, async {
            let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
            let thread = Path::new("/proc").join(std::fs::read_link("/proc/thread-self").unwrap());
            ready.send((listener.local_addr().unwrap(), thread)).unwrap();
            serve(listener, site(token_file.as_deref()), socket).await.unwrap();
        });
    });
    address.recv().unwrap()
}

/// A daemon that sends the latest document every [`FakeDaemon::PERIOD`]. Dropping this value ends the daemon.
struct FakeDaemon {
    document: Arc<Mutex<Option<StatusDocument>>>,
    connections: Arc<AtomicUsize>,
    socket: PathBuf,
}

impl FakeDaemon {
    const PERIOD: Duration = Duration::from_millis(100);

    fn start(socket: &Path, document: StatusDocument) -> Self {
        let socket = stream_path(socket);
        let listener = UnixListener::bind(&socket).unwrap();
        let daemon = Self { document: Arc::new(Mutex::new(Some(document))), connections: Arc::default(), socket };
        let (document, connections) = (Arc::clone(&daemon.document), Arc::clone(&daemon.connections));
        let began = Instant::now();
        thread::spawn(move || {
            for stream in listener.incoming() {
                let (mut stream, document) = (stream.unwrap(), Arc::clone(&document));
                connections.fetch_add(1, Ordering::Relaxed);
                thread::spawn(move || {
                    loop {
                        let document = document.lock().unwrap().clone();
                        let Some(mut document) = document else { return };
                        let elapsed = i64::try_from(began.elapsed().as_nanos()).unwrap();
                        document.time = document.time.plus_nanos(elapsed);
                        let line = serde_json::to_string(&document).unwrap() + "\n";
                        if stream.write_all(line.as_bytes()).is_err() {
                            return;
                        }
                        thread::sleep(Self::PERIOD);
                    }
                });
            }
        });
        daemon
    }

    fn report(&self, document: StatusDocument) {
        *self.document.lock().unwrap() = Some(document);
    }
}

impl Drop for FakeDaemon {
    fn drop(&mut self) {
        *self.document.lock().unwrap() = None;
        std::fs::remove_file(&self.socket).unwrap();
    }
}

/// Sends a request. Returns the connection.
fn send(address: SocketAddr, path: &str, headers: &str) -> BufReader<std::net::TcpStream> {
    let mut stream = std::net::TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n{headers}\r\n").unwrap();
    BufReader::new(stream)
}

fn get(address: SocketAddr, path: &str, headers: &str) -> String {
    let mut answer = String::new();
    send(address, path, headers).read_to_string(&mut answer).unwrap();
    answer
}

/// Reads lines until one begins with `start`.
fn wait_for_line(stream: &mut BufReader<std::net::TcpStream>, start: &str) -> String {
    let mut lines = stream.lines().map(Result::unwrap);
    lines.find(|line| line.starts_with(start)).unwrap_or_else(|| panic!("no line {start}"))
}

#[test]
fn page_and_events_are_served_with_policy() {
    let folder = tempfile::tempdir().unwrap();
    let (address, _) = start_exporter(&folder.path().join("status.sock"), None);
    let page = get(address, "/", "");
    let nonce = page.split("'nonce-").nth(1).and_then(|rest| rest.split('\'').next()).unwrap();
    for wanted in
        ["HTTP/1.1 200", "default-src 'none'", &format!("<script nonce=\"{nonce}\">"), "\"soc_std\"", "no-store"]
    {
        assert!(page.contains(wanted), "{wanted}");
    }
    assert!(!page.contains("NONCE") && !page.contains("CATALOGUE"));
    let other = get(address, "/", "");
    assert!(!other.contains(nonce), "the nonce changes");
    for path in ["/nonsense", "/report"] {
        assert!(get(address, path, "").starts_with("HTTP/1.1 404"), "{path}");
    }
    assert!(get(address, "/-/healthy", "").ends_with("healthy\n"));
}

#[test]
fn one_upstream_connection_serves_all_clients_and_recovers() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("status.sock");
    let daemon = FakeDaemon::start(&socket, sample(4));
    let (address, _) = start_exporter(&socket, None);
    let mut clients: Vec<_> = (0..5).map(|_| send(address, "/events", "")).collect();
    for client in &mut clients {
        assert_eq!(wait_for_line(client, "content-type"), "content-type: text/event-stream");
        wait_for_line(client, "data: [");
        let line = wait_for_line(client, "data: {");
        let document: StatusDocument = serde_json::from_str(&line["data: ".len()..]).unwrap();
        // The time of each document differs.
        assert_eq!(StatusDocument { time: sample(4).time, ..document }, sample(4));
    }
    assert!(get(address, "/metrics", "").contains("packwatch_up 1"));
    assert_eq!(daemon.connections.load(Ordering::Relaxed), 1);
    drop(daemon);
    clients.iter_mut().for_each(|client| drop(wait_for_line(client, "event: gone")));
    assert!(get(address, "/metrics", "").contains("packwatch_up 0"));
    let _daemon = FakeDaemon::start(&socket, sample(4));
    clients.iter_mut().for_each(|client| drop(wait_for_line(client, "data: {")));
    let mut late = send(address, "/events", "");
    let hour: Vec<Vec<Option<f64>>> =
        serde_json::from_str(&wait_for_line(&mut late, "data: [")["data: ".len()..]).unwrap();
    let (first_s, soc) = (hour[0][0].unwrap(), hour[0][1]);
    assert!((0.0..60.0).contains(&(first_s - 1.8e9)) && soc == Some(0.632), "{first_s} {soc:?}");
}

#[test]
fn token_opens_every_path_but_liveness() {
    let folder = tempfile::tempdir().unwrap();
    let (socket, file) = (folder.path().join("status.sock"), folder.path().join("token"));
    std::fs::write(&file, "0123456789abcdef\n").unwrap();
    let (address, _) = start_exporter(&socket, Some(&file));
    for path in ["/", "/events", "/metrics", "/?token=0123456789abcdeF", "/?token=", "/nonsense"] {
        assert!(get(address, path, "").starts_with("HTTP/1.1 401"), "{path}");
    }
    assert!(get(address, "/-/healthy", "").starts_with("HTTP/1.1 200"));
    let moved = get(address, "/?token=0123456789abcdef", "");
    let cookie = "set-cookie: packwatch_token=0123456789abcdef; Path=/; Max-Age=31536000; HttpOnly; SameSite=Lax";
    assert!(
        moved.starts_with("HTTP/1.1 303") && moved.contains("location: /\r\n") && moved.contains(cookie),
        "{moved}"
    );
    for header in ["Authorization: Bearer 0123456789abcdef\r\n", "Cookie: a=b; packwatch_token=0123456789abcdef\r\n"] {
        assert!(get(address, "/metrics", header).starts_with("HTTP/1.1 200"), "{header}");
    }
    for header in ["Authorization: Basic 0123456789abcdef\r\n", "Cookie: token=0123456789abcdef\r\n"] {
        assert!(get(address, "/metrics", header).starts_with("HTTP/1.1 401"), "{header}");
    }
}

#[test]
fn page_without_token_is_for_this_computer_only() {
    let decide = |address: [u8; 4], host: &str, path| {
        let request = Request::builder().uri(path).header("host", host).body(()).unwrap();
        Access::new(address.into(), None).unwrap().decide(&request)
    };
    for (path, elsewhere) in [
        ("/metrics", Decision::Allowed),
        ("/-/healthy", Decision::Allowed),
        ("/", Decision::OnlyLocal),
        ("/events?token=0123456789abcdef", Decision::OnlyLocal),
    ] {
        for host in ["localhost", "localhost:9558", "127.0.0.1:9558", "[::1]:9558", "[::1]"] {
            assert_eq!(decide([127, 0, 0, 1], host, path), Decision::Allowed, "{host} {path}");
        }
        assert_eq!(decide([127, 0, 0, 1], "localhost.example.org:9558", path), elsewhere, "{path}");
        assert_eq!(decide([0, 0, 0, 0], "127.0.0.1:9558", path), elsewhere, "{path}");
    }
}

#[test]
fn unusable_token_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("token");
    let refused = || Access::new([0, 0, 0, 0].into(), Some(&file)).err().expect("an error");
    assert!(refused().contains("cannot be read"));
    for text in ["", "short", "0123456789abcdef;", "0123456789 abcdef", &"a".repeat(129)] {
        std::fs::write(&file, text).unwrap();
        assert!(refused().contains("must be 16 to 128 letters"), "{text}");
    }
}

#[test]
fn scrape_displaces_slow_clients() {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    LocalSet::new().block_on(&runtime, async {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let server = tokio::task::spawn_local(serve(listener, site(None), PathBuf::from("/nonexistent/status.sock")));
        let mut slow = Vec::new();
        for _ in 0..2 * MAX_CONNECTIONS {
            let mut client = TcpStream::connect(address).await.unwrap();
            // The client may already have been rejected.
            let _ = client.write_all(b"GET /met").await;
            slow.push(client);
        }
        sleep(crate::io::connection_slots::GRACE).await;
        let began = Instant::now();
        let mut scrape = TcpStream::connect(address).await.unwrap();
        scrape.write_all(b"GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").await.unwrap();
        let mut answer = String::new();
        scrape.read_to_string(&mut answer).await.unwrap();
        assert!(answer.starts_with("HTTP/1.1 200") && answer.contains("packwatch_up 0"), "{answer}");
        assert!(began.elapsed() < Duration::from_secs(3), "{:?}", began.elapsed());
        server.abort();
    });
}

#[test]
fn openmetrics_is_sent_if_version_1_accepted() {
    for (accept, wanted) in [
        // This is the header of Prometheus 2.42.
        (
            "application/openmetrics-text;version=1.0.0,application/openmetrics-text;version=0.0.1;q=0.75,\
             text/plain;version=0.0.4;q=0.5,*/*;q=0.1",
            true,
        ),
        ("application/openmetrics-text; version=\"1.0.0\"; charset=utf-8", true),
        ("text/plain;version=0.0.4", false),
        ("application/openmetrics-text;version=0.0.1", false),
        ("application/openmetrics-text;version=1.0.0;q=0", false),
        ("*/*", false),
    ] {
        let mut headers = HeaderMap::new();
        headers.insert(ACCEPT, HeaderValue::from_static(accept));
        assert_eq!(wants_openmetrics(&headers), wanted, "{accept}");
    }
    assert!(!wants_openmetrics(&HeaderMap::new()));
}
