//! Compares packwatch's ISO-TP with PyPI `can-isotp` (interpreter `PACKWATCH_PYTHON`). Each must reassemble the
//! messages that the other has segmented. In the test of packwatch's receiver, several senders interleave, and frames
//! are lost or delayed: packwatch must deliver exactly the intact messages.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use packwatch::can::isotp::{Progress, Receiver, segment};
use packwatch::quantity::Timestamp;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use crate::support::oracle::{hex, python};

const MESSAGES: usize = 10_000;
/// Number of senders. Each has its own identifier, and their frames interleave.
const SENDERS: usize = 5;

fn ask(python: &std::ffi::OsString, way: &str, lines: &[String]) -> Vec<String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tools/isotp_oracle.py");
    let mut child =
        Command::new(python).arg(script).arg(way).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let (mut stdin, text) = (child.stdin.take().unwrap(), lines.join("\n"));
    let writer = std::thread::spawn(move || stdin.write_all(text.as_bytes()));
    let output = child.wait_with_output().unwrap();
    writer.join().unwrap().unwrap();
    assert!(output.status.success());
    String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect()
}

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len() / 2).map(|n| u8::from_str_radix(&hex[2 * n..2 * n + 2], 16).unwrap()).collect()
}

struct Chance(ChaCha8Rng);

impl Chance {
    fn below(&mut self, limit: usize) -> usize {
        usize::try_from(self.0.next_u32()).unwrap() % limit
    }

    /// Messages of 1 to 4,095 bytes. Most are short, as in diagnostics.
    fn messages(&mut self) -> Vec<Vec<u8>> {
        let lengths: Vec<usize> = (0..MESSAGES)
            .map(|_| match self.below(20) {
                0 => 1 + self.below(4095),
                _ => 1 + self.below(250),
            })
            .collect();
        let mut message = |length| {
            let mut message = vec![0; length];
            self.0.fill_bytes(&mut message);
            message
        };
        lengths.into_iter().map(&mut message).collect()
    }
}

struct SentFrame {
    ms: i64,
    sender: usize,
    message: usize,
    payload: Vec<u8>,
}

#[test]
fn peer_messages_are_reassembled_despite_loss() {
    let Some(python) = python() else { return };
    let mut chance = Chance(ChaCha8Rng::seed_from_u64(16));
    let messages = chance.messages();
    let lines: Vec<String> = messages.iter().map(|message| hex(message)).collect();
    let cut = ask(&python, "send", &lines);
    assert_eq!(cut.len(), MESSAGES);
    let mut bus: Vec<SentFrame> = Vec::new();
    let mut intact = vec![true; MESSAGES];
    let mut clocks = [0_i64; SENDERS];
    for (message, frames) in cut.iter().enumerate() {
        let sender = message % SENDERS;
        let (is_lossy, is_late) = (chance.below(10) == 0, chance.below(50) == 0);
        let frames: Vec<&str> = frames.split(' ').collect();
        let victim = chance.below(frames.len());
        for (index, payload) in frames.iter().enumerate() {
            clocks[sender] += 1 + i64::try_from(chance.below(20)).unwrap();
            if index == victim && index > 0 && is_late {
                clocks[sender] += 1500;
                intact[message] = false;
            }
            if index == victim && is_lossy {
                intact[message] = false;
                continue;
            }
            bus.push(SentFrame { ms: clocks[sender], sender, message, payload: bytes(payload) });
        }
    }
    bus.sort_by_key(|sent| sent.ms);
    let mut receivers = vec![Receiver::new(None); SENDERS];
    let (mut received, mut faults) = (vec![0; MESSAGES], BTreeMap::new());
    for SentFrame { ms, sender, message, payload } in &bus {
        let heard = receivers[*sender].handle(Timestamp::from_nanos(ms * 1_000_000), payload);
        if let Some(fault) = heard.fault {
            *faults.entry(fault).or_insert(0) += 1;
        }
        if heard.progress == Progress::Complete {
            assert_eq!(receivers[*sender].message(), messages[*message], "message {message} is wrong");
            received[*message] += 1;
        }
    }
    let whole = intact.iter().filter(|intact| **intact).count();
    println!(
        "{MESSAGES} messages, {whole} of them intact; {} accepted; faults {faults:?}",
        received.iter().sum::<i32>()
    );
    for message in 0..MESSAGES {
        assert_eq!(
            received[message],
            i32::from(intact[message]),
            "message {message} of {} bytes",
            messages[message].len()
        );
    }
    assert!(whole < MESSAGES && faults.len() >= 3, "too few frames were lost or damaged");
}

#[test]
fn peer_reassembles_our_messages() {
    let Some(python) = python() else { return };
    let messages = Chance(ChaCha8Rng::seed_from_u64(17)).messages();
    let line = |message: &Vec<u8>| {
        segment(None, message, 0xCC).iter().map(|payload| hex(payload)).collect::<Vec<_>>().join(" ")
    };
    let lines: Vec<String> = messages.iter().map(line).collect();
    let received = ask(&python, "receive", &lines);
    assert_eq!(received.len(), MESSAGES);
    for (message, received) in messages.iter().zip(received) {
        assert_eq!(hex(message), received);
    }
}
