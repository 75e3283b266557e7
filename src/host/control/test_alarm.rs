//! Tests the alarm of a rule from outside: asks the daemon to send the alarm, and listens for its frames on the bus.
//!
//! In: the daemon's configuration, a rule, a duration. Out: a [`ChannelReport`] per interface. Frames are received on a
//! separate socket, and the kernel stamps them with their time. Alarm frames without the test marker are genuine alarms
//! and are counted separately.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::time::{Instant, sleep, timeout};

use super::client::ControlClient;
use super::protocol::{CommandOutcome, Request};
use crate::alarm::{AlarmState, Rule};
use crate::can::dbc::Message;
use crate::can::e2e::{CheckConfig, Receiver, Status, StatusCounts};
use crate::can::signal::SignalPlan;
use crate::can::{CanId, Frame};
use crate::config::{Config, InterfaceConfig};
use crate::io::socket::PassiveSocket;
use crate::io::stop::Stop;
use crate::monitor::{BusEvent, Command, RecordKind};
use crate::quantity::{BusIndex, Timestamp};

/// Period at which the sockets are read. Results do not depend on this period, because the kernel stamps the frames.
const READ_PERIOD: Duration = Duration::from_millis(10);
/// Longest wait for the last frame after the end of the test: fifty ticks (steps of 10 ms) of the daemon.
const GRACE: Duration = Duration::from_millis(500);

/// The alarm frames of one interface.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelReport {
    /// Interface.
    pub interface: String,
    /// Identifier.
    pub id: CanId,
    /// The observed frames.
    pub observed: ObservedFrames,
    /// Results of the end-to-end check of all frames; `None` = the frames are not protected.
    pub protection: Option<StatusCounts>,
    /// Frames dropped by the kernel.
    pub dropped: u64,
    /// Why listening ended before the end of the test; `None` = listening did not end early.
    pub error: Option<String>,
}

/// Counts of observed frames. A test frame is an alarm frame of the tested rule with the test marker.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ObservedFrames {
    /// Number of test frames.
    pub tests: u64,
    /// Time of the first test frame.
    pub first: Option<Timestamp>,
    /// Time of the last test frame.
    pub last: Option<Timestamp>,
    /// Whether the last test frame reported the end of the test.
    pub ended: bool,
    /// Frames of other rules with the test marker. Such frames show that another test is running.
    pub foreign: u64,
    /// Number of frames without the test marker, for each pair of rule code and state code.
    pub genuine: BTreeMap<(u8, u8), u64>,
    /// Frames that could not be decoded.
    pub unreadable: u64,
}

impl ChannelReport {
    /// Whether at least one test frame arrived on this interface, listening did not end early, and no frame was damaged
    /// or missing.
    pub fn is_good(&self) -> bool {
        self.observed.tests > 0 && self.error.is_none() && self.is_intact()
    }

    /// Whether no frame was damaged or missing. Also true if the frames are not protected.
    pub fn is_intact(&self) -> bool {
        let good = [Status::Ok, Status::Initial];
        self.protection.is_none_or(|counts| counts.iter().all(|(status, count)| count == 0 || good.contains(&status)))
    }
}

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

    /// Rule, state and test marker; `None` = the frame is too short, or a code exceeds 255.
    fn read(&self, frame: &Frame) -> Option<(u8, u8, bool)> {
        let raw = |plan: &SignalPlan| plan.raw(frame.data()).ok().and_then(|code| u8::try_from(code).ok());
        Some((raw(&self.rule)?, raw(&self.state)?, raw(&self.test)? != 0))
    }
}

struct MonitoredChannel {
    tap: PassiveSocket,
    reader: AlarmReader,
    check: Option<(CheckConfig, Receiver)>,
    report: ChannelReport,
}

impl MonitoredChannel {
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
        if let Some((config, receiver)) = &mut self.check {
            receiver.check(config, frame.data());
            self.report.protection = Some(*receiver.counts());
        }
        self.report.observed.note(rule, time, self.reader.read(frame));
    }
}

impl ObservedFrames {
    fn note(&mut self, wanted: Rule, time: Timestamp, read: Option<(u8, u8, bool)>) {
        match read {
            None => self.unreadable += 1,
            Some((rule, state, false)) => *self.genuine.entry((rule, state)).or_default() += 1,
            Some((rule, _, true)) if rule != wanted as u8 => self.foreign += 1,
            Some((_, state, true)) => {
                self.tests += 1;
                self.first = self.first.or(Some(time));
                self.last = Some(time);
                self.ended = state == AlarmState::Inactive.wire_code();
            }
        }
    }
}

/// Runs the test. The signals of [`Stop`] end the test early; the daemon then also stops sending the alarm.
///
/// # Errors
/// Fails if no alarm frame is configured, if an interface cannot be opened, or if the daemon does not answer or
/// refuses.
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

/// Opens a socket per interface before the daemon sends anything.
fn open(config: &Config) -> Result<Vec<MonitoredChannel>, String> {
    let path = config.path.display();
    let nothing = || format!("{path}: the daemon sends no frames; an alarm test requires an enabled table [output]");
    let output = config.monitor.output.as_ref().ok_or_else(nothing)?;
    let layout = config.output_layout.as_ref().ok_or_else(nothing)?;
    let message = layout.message(crate::can::encode::LayoutMessage::Alarm.message()).ok_or_else(nothing)?;
    let reader = AlarmReader::new(message).ok_or_else(nothing)?;
    let interfaces = output.buses.iter().filter_map(|bus| config.interfaces.get(bus.index()));
    let channels: Result<Vec<MonitoredChannel>, String> =
        interfaces.map(|interface| open_alarms(interface, message, reader.clone())).collect();
    channels.and_then(|found| if found.is_empty() { Err(nothing()) } else { Ok(found) })
}

fn open_alarms(
    interface: &InterfaceConfig,
    message: &Message,
    reader: AlarmReader,
) -> Result<MonitoredChannel, String> {
    let tap = PassiveSocket::open_for(&interface.name, interface.fd, &[message.id], &[])
        .map_err(|error| error.to_string())?;
    let check = message.e2e.map(|protection| (CheckConfig::new(protection), Receiver::default()));
    let report = ChannelReport {
        interface: interface.name.clone(),
        id: message.id,
        observed: ObservedFrames::default(),
        protection: message.e2e.map(|_| StatusCounts::default()),
        dropped: 0,
        error: None,
    };
    Ok(MonitoredChannel { tap, reader, check, report })
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
        let is_done = |channel: &MonitoredChannel| channel.report.observed.ended || now >= end + GRACE;
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
    fn genuine_frames_do_not_count_as_tests() {
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
        let genuine = [8, 4].map(|rule| ((rule, 1), 1)).into();
        let (first, last) = (Some(at(1.0)), Some(at(6.0)));
        let expected = ObservedFrames { tests: 2, first, last, ended: true, foreign: 1, genuine, unreadable: 1 };
        assert_eq!(observed, expected);
    }

    #[test]
    fn missing_frame_or_counter_fault_is_not_good() {
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
            id: CanId::Standard(0x6B2),
            observed: ObservedFrames { tests, ..ObservedFrames::default() },
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
