//! A test of a rule's alarm frame, seen from outside: asks the daemon to send it and listens for what really goes out.
//!
//! In: the configuration the daemon runs with, a rule, a time. Out: a [`ChannelReport`] per channel. A channel is an
//! interface with an identifier on it; frames come from the kernel with their stamps, from a socket of our own. Frames
//! without the test's marker are real: they are counted apart, by rule.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::signal::unix::{SignalKind, signal};
use tokio::time::{Instant, sleep};

use super::control::client::ControlClient;
use super::control::protocol::{Done, Request};
use crate::alarm::{Rule, State};
use crate::can::dbc::Message;
use crate::can::e2e::{CheckConfig, Receiver, Status, StatusCounts};
use crate::can::signal::SignalPlan;
use crate::can::{CanId, Frame};
use crate::config::Config;
use crate::io::socket::CanListener;
use crate::monitor::Command;
use crate::quantity::Timestamp;

/// How often the sockets are looked at; stamps are the kernel's, so nothing depends on it.
const LOOK_PERIOD: Duration = Duration::from_millis(10);
/// Time the last frame may take after the test's end: fifty ticks of the daemon.
const GRACE: Duration = Duration::from_millis(500);

/// What went out on one channel.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ChannelReport {
    /// Which interface.
    pub(crate) interface: String,
    /// What it carries, for people.
    pub(crate) what: &'static str,
    /// Identifier.
    pub(crate) id: CanId,
    /// What was seen.
    pub(crate) seen: Seen,
    /// Statuses of the end-to-end check of all frames; `None` = they are not protected.
    pub(crate) protection: Option<StatusCounts>,
    /// Frames the kernel dropped before we could see them.
    pub(crate) dropped: u32,
    /// Why listening ended early.
    pub(crate) error: Option<String>,
}

/// Frames seen.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Seen {
    /// Of the rule, with the marker.
    pub(crate) tests: u64,
    /// When the first of them came.
    pub(crate) first: Option<Timestamp>,
    /// When the last.
    pub(crate) last: Option<Timestamp>,
    /// Whether one of them said that the test is over.
    pub(crate) ended: bool,
    /// Of other rules, with the marker: somebody else tests.
    pub(crate) foreign: u64,
    /// Without the marker, by rule and state: real alarms.
    pub(crate) real: BTreeMap<(u8, u8), u64>,
    /// That could not be read.
    pub(crate) unreadable: u64,
}

impl ChannelReport {
    /// Whether the test came through here.
    pub(crate) fn is_good(&self) -> bool {
        self.seen.tests > 0 && self.error.is_none() && self.is_intact()
    }

    /// Whether every frame was whole and none was missing; true without protection.
    pub(crate) fn is_intact(&self) -> bool {
        let good = [Status::Ok, Status::Initial];
        self.protection.is_none_or(|counts| counts.iter().all(|(status, count)| count == 0 || good.contains(&status)))
    }
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
    reader: AlarmReader,
    check: Option<(CheckConfig, Receiver)>,
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
        if let Some((config, receiver)) = &mut self.check {
            receiver.check(config, frame.data());
            self.report.protection = Some(*receiver.counts());
        }
        self.report.seen.note(rule, time, self.reader.read(frame));
    }
}

impl Seen {
    fn note(&mut self, wanted: Rule, time: Timestamp, read: Option<(u8, u8, bool)>) {
        match read {
            None => self.unreadable += 1,
            Some((rule, state, false)) => *self.real.entry((rule, state)).or_default() += 1,
            Some((rule, _, true)) if rule != wanted as u8 => self.foreign += 1,
            Some((_, state, true)) => {
                self.tests += 1;
                self.first = self.first.or(Some(time));
                self.last = Some(time);
                self.ended = state == State::Inactive.wire_code();
            }
        }
    }
}

/// Runs the test; `SIGINT` and `SIGTERM` end it early, at the daemon too.
///
/// # Errors
/// When there is nothing to listen to, an interface cannot be opened, or the daemon does not do it.
pub(crate) fn run(
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
    let message = layout.message(crate::can::encode::LaidOut::Alarm.message()).ok_or_else(nothing)?;
    let reader = AlarmReader::new(message).ok_or_else(nothing)?;
    let interfaces = output.buses.iter().filter_map(|bus| config.interfaces.get(bus.index()));
    let channels: Result<Vec<Channel>, String> = interfaces
        .map(|interface| {
            let listener = CanListener::open(&interface.name, interface.fd, &[message.id]);
            let report = ChannelReport {
                interface: interface.name.clone(),
                what: "alarm frame",
                id: message.id,
                seen: Seen::default(),
                protection: message.e2e.map(|_| StatusCounts::default()),
                dropped: 0,
                error: None,
            };
            let check = message.e2e.map(|protection| (CheckConfig::new(protection), Receiver::default()));
            let listener = listener.map_err(|error| error.to_string())?;
            Ok(Channel { listener, reader: reader.clone(), check, report })
        })
        .collect();
    channels.and_then(|channels| if channels.is_empty() { Err(nothing()) } else { Ok(channels) })
}

async fn watch(channels: &mut [Channel], client: &ControlClient, rule: Rule, duration: Duration) -> Result<(), String> {
    let handler = |kind| signal(kind).map_err(|error| format!("cannot handle signals: {error}"));
    let (mut interrupt, mut terminate) = (handler(SignalKind::interrupt())?, handler(SignalKind::terminate())?);
    tell(client, rule, duration.as_secs_f64())?;
    let end = Instant::now() + duration + GRACE;
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
        let all_ended = channels.iter().all(|channel| channel.report.seen.ended);
        if is_stopped || all_ended || Instant::now() >= end {
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
        let real = BTreeMap::from([((8, 1), 1), ((4, 1), 1)]);
        let expected =
            Seen { tests: 2, first: Some(at(1.0)), last: Some(at(6.0)), ended: true, foreign: 1, real, unreadable: 1 };
        assert_eq!(seen, expected);
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
