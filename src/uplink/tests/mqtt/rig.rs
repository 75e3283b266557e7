//! Provides the test rig of the uplink: a broker, a reader, a daemon's status socket.

#![expect(clippy::unwrap_used, reason = "a step that fails ends the test")]

use std::cell::RefCell;
use std::fs;
use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use packwatch_host::io::stamp::parse_stamp;
use rusqlite::{Connection, OpenFlags};
use serde_json::Value;
use tempfile::TempDir;

/// Longest wait for anything; on an idle machine every wait ends within three seconds.
const PATIENCE: Duration = Duration::from_secs(60);
/// Time of the first document, ns.
const START_NS: i64 = 1_800_000_000_000_000_000;

/// Waits until `is_so` returns true.
pub(crate) fn wait_for(what: &str, mut is_so: impl FnMut() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < end, "{what} did not come within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Builds a status document of the daemon. Its time is `second` seconds after the time of the first document. Cell `n`
/// has a voltage of 3.6 V plus `n` mV.
pub(crate) fn document(cells: usize, second: i64) -> Value {
    let mut document: Value = serde_json::from_str(include_str!("../data/status.json")).unwrap();
    let time = START_NS + second * 1_000_000_000;
    (document["time"], document["wall_time"]) = (time.into(), time.into());
    let pattern = document["cells"][0].clone();
    let cell = |number: usize| {
        let mut cell = pattern.clone();
        cell["cell"] = number.into();
        cell["voltage_v"] = (3.6 + number as f64 / 1000.0).into();
        cell
    };
    document["cells"] = (0..cells).map(cell).collect();
    document
}

/// Seconds from the first document to the `time` of a message.
pub(crate) fn second_of(message: &Value) -> i64 {
    (parse_stamp(message["time"].as_str().unwrap()).unwrap().nanos() - START_NS) / 1_000_000_000
}

/// A broker that keeps its state across restarts.
pub(crate) struct Broker {
    folder: TempDir,
    pub(crate) port: u16,
    process: Option<Child>,
}

impl Broker {
    /// Starts the broker; `more` adds lines to its configuration.
    pub(crate) fn start(more: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let anonymous = if more.contains("allow_anonymous") { "" } else { "allow_anonymous true\n" };
        // By default, a broker started by root changes to another user, who cannot read the test's folder.
        let text = format!(
            "user root\nlistener {port} 127.0.0.1\n{anonymous}{more}persistence true\npersistence_location {}/\nmax_queued_messages 100000\n",
            folder.path().display()
        );
        fs::write(folder.path().join("mosquitto.conf"), text).unwrap();
        let mut broker = Self { folder, port, process: None };
        broker.restart();
        broker
    }

    pub(crate) fn restart(&mut self) {
        let log = fs::File::options().create(true).append(true).open(self.folder.path().join("log")).unwrap();
        let mut command = Command::new("mosquitto");
        command.arg("-c").arg(self.folder.path().join("mosquitto.conf")).stdout(log.try_clone().unwrap()).stderr(log);
        command.env("PATH", format!("{}:/usr/sbin", std::env::var("PATH").unwrap_or_default()));
        self.process = Some(command.spawn().expect("mosquitto starts: Debian's package of that name"));
        let port = self.port;
        wait_for("the broker", || TcpStream::connect(("127.0.0.1", port)).is_ok());
    }

    /// Stops the broker, which stores its state.
    pub(crate) fn stop(&mut self) {
        if let Some(mut process) = self.process.take() {
            signal(&process, "TERM");
            process.wait().unwrap();
        }
    }
}

impl Drop for Broker {
    fn drop(&mut self) {
        self.stop();
    }
}

fn signal(process: &Child, name: &str) {
    Command::new("kill").arg(format!("-{name}")).arg(process.id().to_string()).status().unwrap();
}

pub(crate) struct Daemon {
    folder: TempDir,
    listener: UnixListener,
    client: RefCell<Option<UnixStream>>,
}

impl Daemon {
    pub(crate) fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let listener = UnixListener::bind(folder.path().join("status-stream.sock")).unwrap();
        Self { folder, listener, client: RefCell::new(None) }
    }

    /// Sends a document; accepts a new client if the previous one has disconnected.
    pub(crate) fn send(&self, document: &Value) {
        let line = format!("{document}\n");
        loop {
            let mut client = self.client.borrow_mut();
            let stream = client.get_or_insert_with(|| self.listener.accept().unwrap().0);
            // A client sends nothing, so an end of file means that the client was killed.
            stream.set_nonblocking(true).unwrap();
            let has_gone = matches!(std::io::Read::read(stream, &mut [0]), Ok(0));
            stream.set_nonblocking(false).unwrap();
            if !has_gone && stream.write_all(line.as_bytes()).is_ok() {
                return;
            }
            *client = None;
        }
    }

    /// Closes the connection, like a daemon that exits.
    pub(crate) fn hang_up(&self) {
        *self.client.borrow_mut() = None;
    }
}

pub(crate) struct Uplink {
    folder: Arc<TempDir>,
    process: Child,
}

impl Uplink {
    /// Starts the program; `more` adds lines to its table `[mqtt]`.
    pub(crate) fn start(broker: &Broker, daemon: &Daemon, more: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let socket = daemon.folder.path().join("status.sock");
        let queue = format!("folder = \"{}\"\n", folder.path().display());
        let more = if more.contains("[mqtt.history]") {
            format!("{more}{queue}")
        } else {
            format!("{more}[mqtt.history]\n{queue}")
        };
        let text = format!(
            "[status]\nsocket = \"{}\"\n[mqtt]\nhost = \"127.0.0.1\"\nport = {}\n{more}",
            socket.display(),
            broker.port
        );
        fs::write(folder.path().join("uplink.toml"), text).unwrap();
        Self { process: Self::spawn(folder.path()), folder: Arc::new(folder) }
    }

    fn spawn(folder: &Path) -> Child {
        let log = fs::File::options().create(true).append(true).open(folder.join("log")).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_packwatch-uplink"));
        command
            .args(["mqtt", "-c"])
            .arg(folder.join("uplink.toml"))
            .stderr(log)
            .stdin(Stdio::null())
            .env("NO_COLOR", "1");
        command.spawn().unwrap()
    }

    /// Kills the program, like a power cut.
    pub(crate) fn kill(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }

    /// Terminates the program, like systemd.
    pub(crate) fn terminate(&mut self) {
        signal(&self.process, "TERM");
        assert!(self.process.wait().unwrap().success());
    }

    /// Restarts the program with the same queue.
    pub(crate) fn restart(self) -> Self {
        let folder = Arc::clone(&self.folder);
        drop(self);
        Self { process: Self::spawn(folder.path()), folder }
    }

    pub(crate) fn log(&self) -> String {
        fs::read_to_string(self.folder.path().join("log")).unwrap()
    }

    fn queue(&self) -> PathBuf {
        self.folder.path().join("queue.db")
    }
}

impl Drop for Uplink {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Contents of the queue's file.
pub(crate) struct Fill {
    /// Messages ever written.
    pub(crate) written: u64,
    pub(crate) messages: u64,
}

/// Reads the queue's file; zeros before it exists.
pub(crate) fn fill(uplink: &Uplink) -> Fill {
    let read = || {
        let file = Connection::open_with_flags(uplink.queue(), OpenFlags::SQLITE_OPEN_READ_ONLY)?;
        let one = |query: &str| file.query_row(query, [], |row| row.get::<_, i64>(0)).map(i64::unsigned_abs);
        Ok::<_, rusqlite::Error>(Fill {
            written: one("SELECT coalesce(max(seq), 0) FROM sqlite_sequence")?,
            messages: one("SELECT count(*) FROM message")?,
        })
    };
    read().unwrap_or(Fill { written: 0, messages: 0 })
}

/// A reader with a persistent session: the broker keeps the messages that it misses.
pub(crate) struct Reader {
    process: Child,
    lines: Arc<Mutex<Vec<String>>>,
}

impl Reader {
    pub(crate) fn start(broker: &Broker, topics: &[&str]) -> Self {
        let mut command = Command::new("stdbuf");
        command.args([
            "-oL",
            "mosquitto_sub",
            "-V",
            "mqttv5",
            "-h",
            "127.0.0.1",
            "-p",
            &broker.port.to_string(),
            "-i",
            "reader",
        ]);
        command
            .args(["-c", "-x", "3600", "-q", "1", "-d", "-F", "%t %p"])
            .args(topics.iter().flat_map(|topic| ["-t", topic]));
        let mut process =
            command.stdout(Stdio::piped()).spawn().expect("mosquitto_sub starts: Debian's package mosquitto-clients");
        let lines = Arc::new(Mutex::new(Vec::new()));
        let (output, kept) = (process.stdout.take().unwrap(), Arc::clone(&lines));
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                kept.lock().unwrap().push(line);
            }
        });
        let reader = Self { process, lines };
        wait_for("the subscription", || reader.lines.lock().unwrap().iter().any(|line| line.starts_with("Subscribed")));
        reader
    }

    /// Returns retained messages: topic and text.
    pub(crate) fn retained(broker: &Broker, topic: &str) -> Vec<(String, String)> {
        let mut command = Command::new("mosquitto_sub");
        command.args([
            "-h",
            "127.0.0.1",
            "-p",
            &broker.port.to_string(),
            "-t",
            topic,
            "--retained-only",
            "-W",
            "1",
            "-F",
            "%t %p",
        ]);
        let output = command.output().expect("mosquitto_sub starts: Debian's package mosquitto-clients");
        let text = String::from_utf8(output.stdout).unwrap();
        text.lines()
            .filter_map(|line| line.split_once(' '))
            .map(|(topic, text)| (topic.to_owned(), text.to_owned()))
            .collect()
    }

    /// Returns the messages so far: topic and JSON.
    pub(crate) fn messages(&self) -> Vec<(String, Value)> {
        let lines = self.lines.lock().unwrap();
        let messages = lines.iter().filter_map(|line| line.split_once(' '));
        messages
            .filter(|(topic, _)| topic.starts_with("packwatch/"))
            .map(|(topic, text)| (topic.to_owned(), serde_json::from_str(text).unwrap()))
            .collect()
    }

    pub(crate) fn wait_for_messages(&self, count: usize) {
        wait_for("the messages", || {
            self.lines.lock().unwrap().iter().filter(|line| line.starts_with("packwatch/")).count() >= count
        });
    }

    /// Waits until the latest message of `topic` has the time `second`.
    pub(crate) fn wait_for_topic_time(&self, topic: &str, second: i64) {
        wait_for("the newest value", || {
            let lines = self.lines.lock().unwrap();
            let latest = lines.iter().rev().find_map(|line| line.strip_prefix(topic)?.strip_prefix(' '));
            latest.is_some_and(|text| second_of(&serde_json::from_str(text).unwrap()) == second)
        });
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

fn run(folder: &Path, program: &str, arguments: &str) {
    let output = Command::new(program)
        .args(arguments.split(' '))
        .current_dir(folder)
        .output()
        .unwrap_or_else(|error| panic!("{program}: {error}"));
    assert!(output.status.success(), "{program} {arguments}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Creates `ca.pem`, which signs `broker.pem` for 127.0.0.1, and `other.pem`, another authority.
pub(crate) fn make_certificates(folder: &Path) {
    fs::write(folder.join("names"), "subjectAltName=IP:127.0.0.1\nbasicConstraints=CA:FALSE\n").unwrap();
    let key = "-newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes";
    run(folder, "openssl", &format!("req -x509 {key} -keyout ca.key -out ca.pem -days 2 -subj /CN=ca"));
    run(folder, "openssl", &format!("req -x509 {key} -keyout other.key -out other.pem -days 2 -subj /CN=other"));
    run(folder, "openssl", &format!("req {key} -keyout broker.key -out broker.csr -subj /CN=broker"));
    run(
        folder,
        "openssl",
        "x509 -req -in broker.csr -CA ca.pem -CAkey ca.key -CAcreateserial -days 2 -extfile names -out broker.pem",
    );
}

pub(crate) fn make_password_file(folder: &Path, user: &str, password: &str) {
    run(folder, "mosquitto_passwd", &format!("-b -c passwords {user} {password}"));
}
