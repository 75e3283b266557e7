//! Compares packwatch's end-to-end protection with two independent implementations: PyPI `autosar-e2e` (profiles 1A, 1C
//! and 5) and `cantools` (profile 5). packwatch and the peer must accept each other's payloads, produce equal bytes,
//! and reject a payload with one wrong bit. `PACKWATCH_PYTHON` names the Python interpreter.

use std::ffi::OsString;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use packwatch::can::e2e::{Profile, Protection};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Payloads per profile.
const PAYLOADS: usize = 100_000;

/// The value of `PACKWATCH_PYTHON`. If the variable is not set, prints a note and returns `None`.
fn python() -> Option<OsString> {
    let python = std::env::var_os("PACKWATCH_PYTHON");
    if python.is_none() {
        eprintln!("SKIPPED: PACKWATCH_PYTHON is not set to a Python with autosar-e2e and cantools");
    }
    python
}

fn ask(python: &OsString, lines: &[String]) -> Vec<String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tools/e2e_oracle.py");
    let mut child = Command::new(python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let (mut stdin, text) = (child.stdin.take().unwrap(), lines.join("\n"));
    let writer = std::thread::spawn(move || stdin.write_all(text.as_bytes()));
    let output = child.wait_with_output().unwrap();
    let _ = writer.join().unwrap();
    assert!(output.status.success());
    String::from_utf8(output.stdout).unwrap().lines().map(str::to_owned).collect()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len() / 2).map(|n| u8::from_str_radix(&hex[2 * n..2 * n + 2], 16).unwrap()).collect()
}

struct Case {
    protection: Protection,
    counter: u8,
    /// Payload before protection, with the previous counter value.
    raw: Vec<u8>,
    ours: Vec<u8>,
    flipped: Vec<u8>,
}

impl Case {
    /// Draws a random identifier, length, payload, counter and wrong bit.
    fn random(profile: Profile, random: &mut ChaCha8Rng) -> Self {
        let mut below = |limit: usize| usize::try_from(random.next_u32()).unwrap() % limit;
        let data_id = u16::try_from(below(usize::from(profile.max_data_id()) + 1)).unwrap();
        let protection = Protection { profile, data_id };
        let length = profile.header_bytes() + below(profile.max_bytes() - profile.header_bytes() + 1);
        let previous = u8::try_from(below(usize::from(profile.max_counter()) + 1)).unwrap();
        let bit = below(8 * length);
        let mut raw = vec![0; length];
        random.fill_bytes(&mut raw);
        match profile {
            Profile::P01A | Profile::P01C => raw[1] = raw[1] & 0xF0 | previous,
            Profile::P05 => raw[2] = previous,
        }
        let counter = profile.next_counter(previous);
        let mut ours = raw.clone();
        protection.protect(&mut ours, counter).unwrap();
        let mut flipped = ours.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        Self { protection, counter, raw, ours, flipped }
    }

    fn question(&self) -> String {
        let Protection { profile, data_id } = self.protection;
        format!("{} {data_id} {} {} {}", profile.name(), hex(&self.raw), hex(&self.ours), hex(&self.flipped))
    }

    /// Checks a peer's payload, and whether the peer accepts packwatch's payload and rejects the flipped one.
    fn compare(&self, peer: &str, answer: &[&str]) {
        let what = self.question();
        let [theirs, accepts, accepts_flipped] = answer else { panic!("{peer} answers {answer:?} to {what}") };
        let theirs = bytes(theirs);
        assert_eq!(theirs, self.ours, "{peer} gives other bytes: {what}");
        assert_eq!(self.protection.verified_counter(&theirs), Some(self.counter), "we reject {peer}'s payload: {what}");
        assert_eq!(*accepts, "1", "{peer} rejects our payload: {what}");
        assert_eq!(*accepts_flipped, "0", "{peer} accepts a wrong bit: {what}");
        assert_eq!(self.protection.verified_counter(&self.flipped), None, "we accept a wrong bit: {what}");
    }
}

fn compare(profile: Profile) {
    let Some(python) = python() else { return };
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let cases: Vec<_> = (0..PAYLOADS).map(|_| Case::random(profile, &mut random)).collect();
    let answers = ask(&python, &cases.iter().map(Case::question).collect::<Vec<_>>());
    assert_eq!(answers.len(), cases.len());
    let mut by_cantools = 0;
    for (case, answer) in cases.iter().zip(&answers) {
        let words: Vec<_> = answer.split(' ').collect();
        let (first, second) = words.split_at(3);
        case.compare("autosar-e2e", first);
        if !second.is_empty() {
            case.compare("cantools", second);
            by_cantools += 1;
        }
    }
    // cantools supports profile 5 only, for payloads of at least 4 bytes.
    let wanted = cases.iter().filter(|case| profile == Profile::P05 && case.raw.len() >= 4).count();
    assert_eq!(by_cantools, wanted);
    let counters: std::collections::BTreeSet<_> = cases.iter().map(|case| case.counter).collect();
    assert_eq!(counters.len(), usize::from(profile.max_counter()) + 1, "every counter value must occur");
    eprintln!("profile {}: {} payloads both ways, {by_cantools} of them by cantools too", profile.name(), cases.len());
}

#[test]
fn profile_1a_matches_peer() {
    compare(Profile::P01A);
}

#[test]
fn profile_1c_matches_peer() {
    compare(Profile::P01C);
}

#[test]
fn profile_5_matches_peers() {
    compare(Profile::P05);
}

#[test]
fn peer_rejects_invalid_counter_15_too() {
    let Some(python) = python() else { return };
    let protection = Protection { profile: Profile::P01A, data_id: 0x0123 };
    let payload = |crc: u8| vec![crc, 0x0F, 1, 2];
    let question = |crc: u8| format!("1A 291 00000000 {} {}", hex(&payload(crc)), hex(&payload(crc)));
    let answers = ask(&python, &(0..=255).map(question).collect::<Vec<_>>());
    assert!(answers.len() == 256 && answers.iter().all(|answer| answer.ends_with(" 0 0")), "{answers:?}");
    assert!((0..=255).all(|crc| protection.verified_counter(&payload(crc)).is_none()));
}
