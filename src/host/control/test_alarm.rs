//! Tests a rule's alarm from outside: asks the daemon to send it and listens for the frames that are really sent.
//!
//! In: the configuration of the daemon, a rule, a duration. Out: a [`ChannelReport`] per channel. A channel is an interface
//! with an identifier, that of the alarm frame or of the J1939 node's DM1. Frames come with the kernel's stamps, from a
//! separate socket. Alarm frames without the test marker and trouble codes other than that of the test are genuine alarms;
//! they are counted separately.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::time::{Instant, sleep, timeout};

use super::client::ControlClient;
use super::protocol::{CommandOutcome, Request};
use crate::alarm::{AlarmState, Rule};
use crate::can::dbc::Message;
use crate::can::e2e::{CheckConfig, Receiver, Status, StatusCounts};
use crate::can::j1939::{Dm1Receiver, ReceivedDm1, TroubleCode};
use crate::can::signal::SignalPlan;
use crate::can::{CanId, Frame};
use crate::config::{Config, InterfaceConfig};
use crate::io::socket::PassiveSocket;
use crate::io::stop::Stop;
use crate::monitor::{BusEvent, Command, J1939Config, RecordKind};
use crate::quantity::{BusIndex, Timestamp};

/// Period of reading the sockets; stamps are the kernel's, so nothing depends on it.
const READ_PERIOD: Duration = Duration::from_millis(10);
/// Longest delay of the last frame after the end of the test: fifty ticks of the daemon.
const GRACE: Duration = Duration::from_millis(500);
/// The same for DM1: a change waits a second after the one before it, then for a transfer under way and for its own,
/// each under a second.
const DM1_GRACE: Duration = Duration::from_secs(3);

/// The frames of one channel.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelReport {
    /// Its interface.
    pub interface: String,
    /// Its kind of frames, for the reader.
    pub what: &'static str,
    /// Identifier.
    pub id: CanId,
    /// The frames seen.
    pub observed: ObservedFrames,
    /// The trouble code of the test; `None` = a channel of alarm frames.
    pub test_code: Option<TroubleCode>,
    /// Statuses of the end-to-end check of all frames; `None` = they are not protected.
    pub protection: Option<StatusCounts>,
    /// Frames the kernel dropped.
    pub dropped: u64,
    /// Why listening ended early.
    pub error: Option<String>,
}

/// An alarm that is not part of the test.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum GenuineAlarm {
    /// An alarm frame without the marker.
    Alarm {
        /// The rule's number.
        rule: u8,
        /// The state's.
        state: u8,
    },
    /// Another trouble code in DM1.
    Code {
        /// Suspect parameter number.
        spn: u32,
        /// Failure mode.
        fmi: u8,
    },
}

/// Counts of frames; of DM1, of messages.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ObservedFrames {
    /// Frames of the rule, with the marker; DM1 with the test code.
    pub tests: u64,
    /// Time of the first of them.
    pub first: Option<Timestamp>,
    /// Time of the last.
    pub last: Option<Timestamp>,
    /// Whether one of them reported the end of the test.
    pub ended: bool,
    /// Frames of other rules, with the marker: another test runs.
    pub foreign: u64,
    /// Frames or messages per genuine alarm.
    pub genuine: BTreeMap<GenuineAlarm, u64>,
    /// DM1 without the test code.
    pub without_code: u64,
    /// Frames that could not be read.
    pub unreadable: u64,
}

impl ChannelReport {
    fn new(interface: &InterfaceConfig, what: &'static str, id: CanId) -> Self {
        Self {
            interface: interface.name.clone(),
            what,
            id,
            observed: ObservedFrames::default(),
            test_code: None,
            protection: None,
            dropped: 0,
            error: None,
        }
    }

    /// Longest delay of its last frame after the end of the test.
    fn grace(&self) -> Duration {
        if self.test_code.is_some() { DM1_GRACE } else { GRACE }
    }

    /// Whether the test arrived on this channel.
    pub fn is_good(&self) -> bool {
        self.observed.tests > 0 && self.error.is_none() && self.is_intact()
    }

    /// Whether every frame was intact and none was missing; true without protection.
    pub fn is_intact(&self) -> bool {
        let good = [Status::Ok, Status::Initial];
        self.protection.is_none_or(|counts| counts.iter().all(|(status, count)| count == 0 || good.contains(&status)))
    }
}

/// Reads the frames of a channel.
#[expect(clippy::large_enum_variant, reason = "one per channel of a test: a handful")]
enum ChannelReader {
    Alarm { reader: AlarmReader, check: Option<(CheckConfig, Receiver)> },
    Dm1 { receiver: Dm1Receiver, test_code: TroubleCode },
}

/// The signals of an alarm frame.
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

    /// Rule, state and marker; `None` = the frame is too short, or the number of its rule is too high.
    fn read(&self, frame: &Frame) -> Option<(u8, u8, bool)> {
        let raw = |plan: &SignalPlan| plan.raw(frame.data()).ok().and_then(|code| u8::try_from(code).ok());
        Some((raw(&self.rule)?, raw(&self.state)?, raw(&self.test)? != 0))
    }
}

/// One channel during the test.
struct MonitoredChannel {
    tap: PassiveSocket,
    reader: ChannelReader,
    report: ChannelReport,
}

impl MonitoredChannel {
    /// Reads all received frames.
    fn read_all(&mut self, rule: Rule) {
        let mut received = Vec::new();
        while self.report.error.is_none() {
            match self.tap.next(BusIndex(0), &mut received) {
                Ok(true) => {}
                Ok(false) => break,
                Err(error) => self.report.error = Some(error.to_string()),
            }
        }
        for record in &received {
            match &record.kind {
                RecordKind::Frame { frame, .. } => self.take(rule, record.time, frame),
                RecordKind::Bus { event: BusEvent::Dropped { frames }, .. } => self.report.dropped += frames,
                _ => {}
            }
        }
    }

    fn take(&mut self, rule: Rule, time: Timestamp, frame: &Frame) {
        let observed = &mut self.report.observed;
        match &mut self.reader {
            ChannelReader::Alarm { reader, check } => {
                if let Some((config, receiver)) = check {
                    receiver.check(config, frame.data());
                    self.report.protection = Some(*receiver.counts());
                }
                observed.note(rule, time, reader.read(frame));
            }
            ChannelReader::Dm1 { receiver, test_code } => {
                if let Some(message) = receiver.take(frame) {
                    observed.note_dm1(*test_code, time, &message);
                }
            }
        }
    }
}

impl ObservedFrames {
    fn note(&mut self, wanted: Rule, time: Timestamp, read: Option<(u8, u8, bool)>) {
        match read {
            None => self.unreadable += 1,
            Some((rule, state, false)) => *self.genuine.entry(GenuineAlarm::Alarm { rule, state }).or_default() += 1,
            Some((rule, _, true)) if rule != wanted as u8 => self.foreign += 1,
            Some((_, state, true)) => {
                self.note_test(time);
                self.ended = state == AlarmState::Inactive.wire_code();
            }
        }
    }

    /// Notes a DM1. The test has ended when its code, once seen, is absent again.
    fn note_dm1(&mut self, test_code: TroubleCode, time: Timestamp, message: &ReceivedDm1) {
        let ReceivedDm1::Codes(codes) = message else {
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
            *self.genuine.entry(GenuineAlarm::Code { spn: code.spn(), fmi: code.fmi() }).or_default() += 1;
        }
    }

    fn note_test(&mut self, time: Timestamp) {
        self.tests += 1;
        self.first = self.first.or(Some(time));
        self.last = Some(time);
    }
}

/// Runs the test; `SIGINT` and `SIGTERM` end it early, also in the daemon.
///
/// # Errors
/// When there is no channel, an interface cannot be opened, or the daemon refuses.
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

/// Opens a socket per channel, before anything is sent.
fn open(config: &Config) -> Result<Vec<MonitoredChannel>, String> {
    let path = config.path.display();
    let nothing = || format!("{path}: nothing is sent, must have a table [output] that is enabled");
    let output = config.monitor.output.as_ref().ok_or_else(nothing)?;
    let layout = config.output_layout.as_ref().ok_or_else(nothing)?;
    let message = layout.message(crate::can::encode::LayoutMessage::Alarm.message()).ok_or_else(nothing)?;
    let reader = AlarmReader::new(message).ok_or_else(nothing)?;
    let interfaces = output.buses.iter().filter_map(|bus| config.interfaces.get(bus.index()));
    let channels: Result<Vec<MonitoredChannel>, String> =
        interfaces.map(|interface| open_alarms(interface, message, reader.clone())).collect();
    let mut channels = channels.and_then(|found| if found.is_empty() { Err(nothing()) } else { Ok(found) })?;
    if let Some(j1939) = &config.monitor.j1939
        && let Some(interface) = config.interfaces.get(j1939.bus.index())
    {
        channels.push(open_dm1(interface, j1939)?);
    }
    Ok(channels)
}

fn open_alarms(
    interface: &InterfaceConfig,
    message: &Message,
    reader: AlarmReader,
) -> Result<MonitoredChannel, String> {
    let tap = PassiveSocket::open_for(&interface.name, interface.fd, &[message.id], &[])
        .map_err(|error| error.to_string())?;
    let check = message.e2e.map(|protection| (CheckConfig::new(protection), Receiver::default()));
    let mut report = ChannelReport::new(interface, "alarm frame", message.id);
    report.protection = message.e2e.map(|_| StatusCounts::default());
    Ok(MonitoredChannel { tap, reader: ChannelReader::Alarm { reader, check }, report })
}

/// Opens the channel of DM1. J1939 is classic CAN only.
fn open_dm1(interface: &InterfaceConfig, j1939: &J1939Config) -> Result<MonitoredChannel, String> {
    let receiver = Dm1Receiver::new(j1939.node.address);
    let tap = PassiveSocket::open_for(&interface.name, false, &[], &receiver.patterns())
        .map_err(|error| error.to_string())?;
    let [id, ..] = j1939.node.sent_ids();
    let mut report = ChannelReport::new(interface, "J1939 DM1", id);
    report.test_code = Some(j1939.test_code);
    Ok(MonitoredChannel { tap, reader: ChannelReader::Dm1 { receiver, test_code: j1939.test_code }, report })
}

async fn watch(
    channels: &mut [MonitoredChannel],
    client: &ControlClient,
    rule: Rule,
    duration: Duration,
) -> Result<(), String> {
    let mut stop = Stop::new(None).map_err(|error| format!("cannot handle signals: {error}"))?;
    send_test(client, rule, duration.as_secs_f64())?;
    let end = Instant::now() + duration;
    let mut outcome = Ok(());
    loop {
        let is_stopped = timeout(READ_PERIOD, stop.wait()).await.is_ok();
        if is_stopped {
            outcome = send_test(client, rule, 0.0);
            sleep(GRACE).await;
        }
        channels.iter_mut().for_each(|channel| channel.read_all(rule));
        let now = Instant::now();
        let is_done = |channel: &MonitoredChannel| channel.report.observed.ended || now >= end + channel.report.grace();
        if is_stopped || channels.iter().all(is_done) {
            return outcome;
        }
    }
}

fn send_test(client: &ControlClient, rule: Rule, seconds: f64) -> Result<(), String> {
    let done: CommandOutcome = client.ask(Request::Command(Command::Test { rule, seconds }))?;
    if done.refused == 0 { Ok(()) } else { Err("the daemon sends nothing: its configuration has no output".to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn genuine_frames_are_never_taken_for_tests() {
        let mut observed = ObservedFrames::default();
        let rule = Rule::SocLow;
        let at = |seconds: f64| Timestamp::from_secs(seconds);
        observed.note(rule, at(1.0), Some((8, 1, true)));
        observed.note(rule, at(2.0), Some((8, 1, false)));
        observed.note(rule, at(3.0), Some((4, 1, false)));
        observed.note(rule, at(4.0), Some((4, 1, true)));
        observed.note(rule, at(5.0), None);
        assert!(!observed.ended);
        observed.note(rule, at(6.0), Some((8, 0, true)));
        let genuine = [8, 4].map(|rule| (GenuineAlarm::Alarm { rule, state: 1 }, 1)).into();
        let (first, last) = (Some(at(1.0)), Some(at(6.0)));
        let expected =
            ObservedFrames { tests: 2, first, last, ended: true, foreign: 1, genuine, without_code: 0, unreadable: 1 };
        assert_eq!(observed, expected);
    }

    #[test]
    fn dm1_is_counted_with_and_without_the_test_code_and_other_codes_are_genuine() {
        let code = |spn, fmi, count| TroubleCode::new(spn, fmi, count).unwrap();
        let (test_code, other) = (code(524_286, 31, 0), code(520_196, 9, 1));
        let at = |seconds: f64| Timestamp::from_secs(seconds);
        let mut observed = ObservedFrames::default();
        let mut note = |seconds, codes: &[TroubleCode]| {
            observed.note_dm1(test_code, at(seconds), &ReceivedDm1::Codes(codes.to_vec()));
            observed.ended
        };
        assert!(!note(1.0, &[]), "not begun is not ended");
        assert!(!note(2.0, &[code(524_286, 2, 0)]), "another failure of the same parameter is not the test");
        assert!(!note(3.0, &[other, code(524_286, 31, 7)]), "however often it came");
        assert!(!note(4.0, &[test_code]));
        assert!(note(5.0, &[other]));
        assert!(!note(6.0, &[test_code]), "it came back");
        assert!(note(7.0, &[]));
        observed.note_dm1(test_code, at(8.0), &ReceivedDm1::Unreadable);
        let genuine = [(520_196, 9, 2), (524_286, 2, 1)];
        let genuine = genuine.map(|(spn, fmi, count)| (GenuineAlarm::Code { spn, fmi }, count)).into();
        let (first, last) = (Some(at(3.0)), Some(at(6.0)));
        let expected =
            ObservedFrames { tests: 3, first, last, ended: true, foreign: 0, genuine, without_code: 4, unreadable: 1 };
        assert_eq!(observed, expected);
    }

    #[test]
    fn dm1_without_the_test_code_is_not_good() {
        let report = |tests| ChannelReport {
            interface: "can0".to_owned(),
            what: "J1939 DM1",
            id: CanId::Extended(0x18FE_CAF9),
            observed: ObservedFrames { tests, without_code: 3, ..ObservedFrames::default() },
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
            observed: ObservedFrames { tests, ..ObservedFrames::default() },
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
