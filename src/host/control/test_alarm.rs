//! A test of a rule's alarm, seen from outside: asks the daemon to send it and listens for what really goes out.
//!
//! In: the configuration the daemon runs with, a rule, a time. Out: a [`ChannelReport`] per channel. A channel is an
//! interface with an identifier on it, the alarm frame's or that of the J1939 node's DM1; frames come from the kernel with
//! their stamps, from a socket of our own. Alarm frames without the test's marker and trouble codes other than the test's
//! are real: they are counted apart.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::signal::unix::{SignalKind, signal};
use tokio::time::{Instant, sleep};

use super::client::ControlClient;
use super::protocol::{Done, Request};
use crate::alarm::{AlarmState, Rule};
use crate::can::dbc::Message;
use crate::can::e2e::{CheckConfig, Receiver, Status, StatusCounts};
use crate::can::j1939::{Dm1Receiver, ReceivedDm1, TroubleCode};
use crate::can::signal::SignalPlan;
use crate::can::{CanId, Frame};
use crate::config::{Config, InterfaceConfig};
use crate::io::socket::CanListener;
use crate::monitor::{Command, J1939Config};
use crate::quantity::Timestamp;

/// How often the sockets are looked at; stamps are the kernel's, so nothing depends on it.
const LOOK_PERIOD: Duration = Duration::from_millis(10);
/// Time the last frame may take after the test's end: fifty ticks of the daemon.
const GRACE: Duration = Duration::from_millis(500);
/// The same for DM1: a change waits a second after the one before it, then for a transfer under way and for its own,
/// each under a second.
const DM1_GRACE: Duration = Duration::from_secs(3);

/// What went out on one channel.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelReport {
    /// Which interface.
    pub interface: String,
    /// What it carries, for people.
    pub what: &'static str,
    /// Identifier.
    pub id: CanId,
    /// What was seen.
    pub seen: Seen,
    /// The trouble code that is looked for; `None` = a channel of alarm frames.
    pub test_code: Option<TroubleCode>,
    /// Statuses of the end-to-end check of all frames; `None` = they are not protected.
    pub protection: Option<StatusCounts>,
    /// Frames the kernel dropped before we could see them.
    pub dropped: u32,
    /// Why listening ended early.
    pub error: Option<String>,
}

/// Something real.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Real {
    /// An alarm frame without the marker.
    Alarm {
        /// The rule's number.
        rule: u8,
        /// The state's.
        state: u8,
    },
    /// Another trouble code in DM1.
    Code {
        /// What is wrong.
        spn: u32,
        /// How.
        fmi: u8,
    },
}

/// Frames seen; of DM1, messages.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Seen {
    /// Of the rule, with the marker; of DM1, with the test code.
    pub tests: u64,
    /// When the first of them came.
    pub first: Option<Timestamp>,
    /// When the last.
    pub last: Option<Timestamp>,
    /// Whether one of them said that the test is over.
    pub ended: bool,
    /// Of other rules, with the marker: somebody else tests.
    pub foreign: u64,
    /// How many told of each real alarm.
    pub real: BTreeMap<Real, u64>,
    /// Of DM1, those without the test code.
    pub without_code: u64,
    /// That could not be read.
    pub unreadable: u64,
}

impl ChannelReport {
    fn new(interface: &InterfaceConfig, what: &'static str, id: CanId) -> Self {
        Self {
            interface: interface.name.clone(),
            what,
            id,
            seen: Seen::default(),
            test_code: None,
            protection: None,
            dropped: 0,
            error: None,
        }
    }

    /// Time the last of it may take after the test's end.
    fn grace(&self) -> Duration {
        if self.test_code.is_some() { DM1_GRACE } else { GRACE }
    }

    /// Whether the test came through here.
    pub fn is_good(&self) -> bool {
        self.seen.tests > 0 && self.error.is_none() && self.is_intact()
    }

    /// Whether every frame was whole and none was missing; true without protection.
    pub fn is_intact(&self) -> bool {
        let good = [Status::Ok, Status::Initial];
        self.protection.is_none_or(|counts| counts.iter().all(|(status, count)| count == 0 || good.contains(&status)))
    }
}

/// How a channel's frames are read.
#[expect(clippy::large_enum_variant, reason = "one per channel of a test: a handful")]
enum Reader {
    Alarm { reader: AlarmReader, check: Option<(CheckConfig, Receiver)> },
    Dm1 { receiver: Dm1Receiver, test_code: TroubleCode },
}

/// How to read an alarm frame.
#[derive(Debug, Clone)]
struct AlarmReader {
    rule: SignalPlan,
    state: SignalPlan,
    test: SignalPlan,
}

impl AlarmReader {
    fn new(message: &Message) -> Option<Self> {
        let plan = |name| message.signal(name).and_then(|signal| signal.layout.plan().ok());
        Some(Self { rule: plan("Rule")?, state: plan("State")?, test: plan("Test")? })
    }

    /// Rule, state and marker; `None` = the frame is too short, or no rule has so high a number.
    fn read(&self, frame: &Frame) -> Option<(u8, u8, bool)> {
        let raw = |plan: &SignalPlan| plan.raw(frame.data()).ok().and_then(|code| u8::try_from(code).ok());
        Some((raw(&self.rule)?, raw(&self.state)?, raw(&self.test)? != 0))
    }
}

/// One channel while it is listened to.
struct Channel {
    listener: CanListener,
    reader: Reader,
    report: ChannelReport,
}

impl Channel {
    /// Takes what has come.
    fn take_all(&mut self, rule: Rule) {
        while self.report.error.is_none() {
            match self.listener.next() {
                Ok(None) => break,
                Ok(Some((time, frame))) => self.take(rule, time, &frame),
                Err(error) => self.report.error = Some(error.to_string()),
            }
        }
        self.report.dropped = self.listener.dropped();
    }

    fn take(&mut self, rule: Rule, time: Timestamp, frame: &Frame) {
        let seen = &mut self.report.seen;
        match &mut self.reader {
            Reader::Alarm { reader, check } => {
                if let Some((config, receiver)) = check {
                    receiver.check(config, frame.data());
                    self.report.protection = Some(*receiver.counts());
                }
                seen.note(rule, time, reader.read(frame));
            }
            Reader::Dm1 { receiver, test_code } => {
                if let Some(heard) = receiver.take(frame) {
                    seen.note_dm1(*test_code, time, &heard);
                }
            }
        }
    }
}

impl Seen {
    fn note(&mut self, wanted: Rule, time: Timestamp, read: Option<(u8, u8, bool)>) {
        match read {
            None => self.unreadable += 1,
            Some((rule, state, false)) => *self.real.entry(Real::Alarm { rule, state }).or_default() += 1,
            Some((rule, _, true)) if rule != wanted as u8 => self.foreign += 1,
            Some((_, state, true)) => {
                self.note_test(time);
                self.ended = state == AlarmState::Inactive.wire_code();
            }
        }
    }

    /// The test has ended when its code, once seen, is no longer there.
    fn note_dm1(&mut self, test_code: TroubleCode, time: Timestamp, heard: &ReceivedDm1) {
        let ReceivedDm1::Codes(codes) = heard else {
            self.unreadable += 1;
            return;
        };
        if codes.iter().any(|code| code.is_same_failure(test_code)) {
            self.note_test(time);
            self.ended = false;
        } else {
            self.without_code += 1;
            self.ended = self.tests > 0;
        }
        for code in codes.iter().filter(|code| !code.is_same_failure(test_code)) {
            *self.real.entry(Real::Code { spn: code.spn(), fmi: code.fmi() }).or_default() += 1;
        }
    }

    fn note_test(&mut self, time: Timestamp) {
        self.tests += 1;
        self.first = self.first.or(Some(time));
        self.last = Some(time);
    }
}

/// Runs the test; `SIGINT` and `SIGTERM` end it early, at the daemon too.
///
/// # Errors
/// When there is nothing to listen to, an interface cannot be opened, or the daemon does not do it.
pub fn run(
    config: &Config,
    client: &ControlClient,
    rule: Rule,
    duration: Duration,
) -> Result<Vec<ChannelReport>, String> {
    let mut channels = open(config)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|error| format!("cannot start: {error}"))?;
    runtime.block_on(watch(&mut channels, client, rule, duration))?;
    Ok(channels.into_iter().map(|channel| channel.report).collect())
}

/// A socket per channel, before anything is sent.
fn open(config: &Config) -> Result<Vec<Channel>, String> {
    let path = config.path.display();
    let nothing = || format!("{path}: nothing is sent, must have a table [output] that is enabled");
    let output = config.monitor.output.as_ref().ok_or_else(nothing)?;
    let layout = config.output_layout.as_ref().ok_or_else(nothing)?;
    let message = layout.message(crate::can::encode::LayoutMessage::Alarm.message()).ok_or_else(nothing)?;
    let reader = AlarmReader::new(message).ok_or_else(nothing)?;
    let interfaces = output.buses.iter().filter_map(|bus| config.interfaces.get(bus.index()));
    let channels: Result<Vec<Channel>, String> =
        interfaces.map(|interface| open_alarms(interface, message, reader.clone())).collect();
    let mut channels = channels.and_then(|found| if found.is_empty() { Err(nothing()) } else { Ok(found) })?;
    if let Some(j1939) = &config.monitor.j1939
        && let Some(interface) = config.interfaces.get(j1939.bus.index())
    {
        channels.push(open_dm1(interface, j1939)?);
    }
    Ok(channels)
}

fn open_alarms(interface: &InterfaceConfig, message: &Message, reader: AlarmReader) -> Result<Channel, String> {
    let listener = CanListener::open(&interface.name, interface.fd, &[message.id], &[]);
    let listener = listener.map_err(|error| error.to_string())?;
    let check = message.e2e.map(|protection| (CheckConfig::new(protection), Receiver::default()));
    let mut report = ChannelReport::new(interface, "alarm frame", message.id);
    report.protection = message.e2e.map(|_| StatusCounts::default());
    Ok(Channel { listener, reader: Reader::Alarm { reader, check }, report })
}

/// J1939 is classic only.
fn open_dm1(interface: &InterfaceConfig, j1939: &J1939Config) -> Result<Channel, String> {
    let receiver = Dm1Receiver::new(j1939.node.address);
    let listener = CanListener::open(&interface.name, false, &[], &receiver.patterns());
    let listener = listener.map_err(|error| error.to_string())?;
    let [id, ..] = j1939.node.sent_ids();
    let mut report = ChannelReport::new(interface, "J1939 DM1", id);
    report.test_code = Some(j1939.test_code);
    Ok(Channel { listener, reader: Reader::Dm1 { receiver, test_code: j1939.test_code }, report })
}

async fn watch(channels: &mut [Channel], client: &ControlClient, rule: Rule, duration: Duration) -> Result<(), String> {
    let handler = |kind| signal(kind).map_err(|error| format!("cannot handle signals: {error}"));
    let (mut interrupt, mut terminate) = (handler(SignalKind::interrupt())?, handler(SignalKind::terminate())?);
    tell(client, rule, duration.as_secs_f64())?;
    let end = Instant::now() + duration;
    let mut outcome = Ok(());
    loop {
        let is_stopped = tokio::select! {
            _ = interrupt.recv() => true,
            _ = terminate.recv() => true,
            () = sleep(LOOK_PERIOD) => false,
        };
        if is_stopped {
            outcome = tell(client, rule, 0.0);
            sleep(GRACE).await;
        }
        channels.iter_mut().for_each(|channel| channel.take_all(rule));
        let now = Instant::now();
        let is_done = |channel: &Channel| channel.report.seen.ended || now >= end + channel.report.grace();
        if is_stopped || channels.iter().all(is_done) {
            return outcome;
        }
    }
}

fn tell(client: &ControlClient, rule: Rule, seconds: f64) -> Result<(), String> {
    let done: Done = client.ask(Request::Command(Command::Test { rule, seconds }))?;
    if done.refused == 0 { Ok(()) } else { Err("the daemon sends nothing: its configuration has no output".to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn real_frames_are_never_taken_for_tests() {
        let mut seen = Seen::default();
        let rule = Rule::SocLow;
        let at = |seconds: f64| Timestamp::from_secs(seconds);
        seen.note(rule, at(1.0), Some((8, 1, true)));
        seen.note(rule, at(2.0), Some((8, 1, false)));
        seen.note(rule, at(3.0), Some((4, 1, false)));
        seen.note(rule, at(4.0), Some((4, 1, true)));
        seen.note(rule, at(5.0), None);
        assert!(!seen.ended);
        seen.note(rule, at(6.0), Some((8, 0, true)));
        let real = [8, 4].map(|rule| (Real::Alarm { rule, state: 1 }, 1)).into();
        let (first, last) = (Some(at(1.0)), Some(at(6.0)));
        let expected = Seen { tests: 2, first, last, ended: true, foreign: 1, real, without_code: 0, unreadable: 1 };
        assert_eq!(seen, expected);
    }

    #[test]
    fn dm1_is_counted_with_and_without_the_test_code_and_other_codes_are_real() {
        let code = |spn, fmi, count| TroubleCode::new(spn, fmi, count).unwrap();
        let (test_code, other) = (code(524_286, 31, 0), code(520_196, 9, 1));
        let at = |seconds: f64| Timestamp::from_secs(seconds);
        let mut seen = Seen::default();
        let mut hear = |seconds, codes: &[TroubleCode]| {
            seen.note_dm1(test_code, at(seconds), &ReceivedDm1::Codes(codes.to_vec()));
            seen.ended
        };
        assert!(!hear(1.0, &[]), "not begun is not ended");
        assert!(!hear(2.0, &[code(524_286, 2, 0)]), "another failure of the same parameter is not the test");
        assert!(!hear(3.0, &[other, code(524_286, 31, 7)]), "however often it came");
        assert!(!hear(4.0, &[test_code]));
        assert!(hear(5.0, &[other]));
        assert!(!hear(6.0, &[test_code]), "it came back");
        assert!(hear(7.0, &[]));
        seen.note_dm1(test_code, at(8.0), &ReceivedDm1::Unreadable);
        let real = [(520_196, 9, 2), (524_286, 2, 1)];
        let real = real.map(|(spn, fmi, count)| (Real::Code { spn, fmi }, count)).into();
        let (first, last) = (Some(at(3.0)), Some(at(6.0)));
        let expected = Seen { tests: 3, first, last, ended: true, foreign: 0, real, without_code: 4, unreadable: 1 };
        assert_eq!(seen, expected);
    }

    #[test]
    fn dm1_without_the_test_code_is_not_good() {
        let report = |tests| ChannelReport {
            interface: "can0".to_owned(),
            what: "J1939 DM1",
            id: CanId::Extended(0x18FE_CAF9),
            seen: Seen { tests, without_code: 3, ..Seen::default() },
            test_code: Some(TroubleCode::new(524_286, 31, 0).unwrap()),
            protection: None,
            dropped: 0,
            error: None,
        };
        assert!(report(1).is_good());
        assert!(!report(0).is_good());
        assert_eq!(report(0).grace(), DM1_GRACE);
    }

    #[test]
    fn a_channel_without_a_frame_or_with_a_broken_counter_is_not_good() {
        use crate::can::e2e::{Profile, Protection};
        let protection = Protection { profile: Profile::P01A, data_id: 0x123 };
        let config = CheckConfig::new(protection);
        let counts = |counters: &[u8]| {
            let mut receiver = Receiver::default();
            for &counter in counters {
                let mut payload = [0; 8];
                protection.protect(&mut payload, counter).unwrap();
                receiver.check(&config, &payload);
            }
            Some(*receiver.counts())
        };
        let report = |tests, protection| ChannelReport {
            interface: "can0".to_owned(),
            what: "alarm frame",
            id: CanId::Standard(0x6B2),
            seen: Seen { tests, ..Seen::default() },
            test_code: None,
            protection,
            dropped: 0,
            error: None,
        };
        assert!(report(3, counts(&[3, 4, 5])).is_good());
        assert!(report(3, None).is_good());
        assert!(!report(0, None).is_good());
        assert!(!report(3, counts(&[3, 4, 4])).is_good());
        assert!(!report(3, counts(&[3, 4, 9])).is_good());
    }
}
