//! Runs `packwatch-uplink mqtt` as a user does: the real program, a real broker (Debian's mosquitto) on a loopback
//! port, and a reader (mosquitto_sub) with its own session. The test sends the documents through a status socket.

mod rig;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::time::Duration;

use rig::{Broker, Daemon, Reader, Uplink, document, fill, wait_for};
use serde_json::Value;

/// Retry every second and sample every document.
const EAGER: &str = "period_s = 1\nretry_max_s = 1\n[mqtt.history]\nperiod_s = 1\n";

#[test]
fn cells_are_published_in_millivolts_and_retained() {
    let (broker, daemon) = (Broker::start(""), Daemon::start());
    let _uplink = Uplink::start(&broker, &daemon, EAGER);
    let mut pack = document(96, 0);
    pack["cells"][95]["voltage_v"] = Value::Null;
    daemon.send(&pack);
    wait_for("discovery", || Reader::retained(&broker, "homeassistant/#").len() == 183);
    // This reader connects late and gets the retained messages.
    let kept: BTreeMap<_, _> = Reader::retained(&broker, "packwatch/#").into_iter().collect();
    assert_eq!(
        kept.keys().collect::<Vec<_>>(),
        ["packwatch/daemon", "packwatch/info", "packwatch/spec_data", "packwatch/status", "packwatch/uplink"]
    );
    assert_eq!((kept["packwatch/status"].as_str(), kept["packwatch/daemon"].as_str()), ("online", "online"));
    let cells: Value = serde_json::from_str(&kept["packwatch/spec_data"]).unwrap();
    let expected: Vec<Value> = (0..95).map(|cell| Value::from(3600 + cell)).chain([Value::Null]).collect();
    assert_eq!(cells["cell_voltages_mv"], Value::from(expected));
    assert_eq!((&cells["cell_voltages"][94], &cells["cell_voltages"][95]), (&Value::from(3.694), &Value::Null));
    let info: Value = serde_json::from_str(&kept["packwatch/info"]).unwrap();
    assert_eq!(
        (&info["SOC"], &info["SOC_std"], &info["battery_current"]),
        (&63.2.into(), &1.2.into(), &(-12.5).into())
    );
    // With one unknown voltage, minimum and maximum are unknown.
    assert_eq!((&info["cell_max_voltage"], &info["SOC_reported"]), (&Value::Null, &Value::Null));
    assert_eq!(
        info["alarms"],
        serde_json::json!({ "capacity_low": true, "recharge_period_low": null, "soc_low": false })
    );
}

#[test]
fn last_will_marks_uplink_and_topic_marks_silent_daemon() {
    let (broker, daemon) = (Broker::start(""), Daemon::start());
    let mut uplink = Uplink::start(&broker, &daemon, EAGER);
    let status = |topic: &str| Reader::retained(&broker, topic).pop().map(|(_, text)| text).unwrap_or_default();
    wait_for("online", || status("packwatch/status") == "online" && status("packwatch/daemon") == "offline");
    daemon.send(&document(1, 0));
    wait_for("a daemon", || status("packwatch/daemon") == "online");
    daemon.hang_up();
    wait_for("a silent daemon", || status("packwatch/daemon") == "offline" && status("packwatch/status") == "online");
    uplink.kill();
    wait_for("the last will", || status("packwatch/status") == "offline");

    let mut uplink = Uplink::start(&broker, &daemon, EAGER);
    wait_for("online again", || status("packwatch/status") == "online");
    uplink.terminate();
    assert_eq!(status("packwatch/status"), "offline");
}

#[test]
fn hour_without_broker_and_two_power_cuts_lose_nothing() {
    const HOUR: i64 = 3600;
    let (mut broker, daemon) = (Broker::start(""), Daemon::start());
    let reader = Reader::start(&broker, &["packwatch/history", "packwatch/events", "packwatch/info"]);
    let mut uplink = Uplink::start(&broker, &daemon, EAGER);
    daemon.send(&document(96, 0));
    reader.wait_for_messages(4);
    // Messages that the broker has received but not confirmed stay in the queue, so the test waits for the receipts.
    wait_for("the broker's receipts", || fill(&uplink).messages == 0);
    broker.stop();
    for second in 1..=HOUR {
        if second == HOUR / 2 {
            uplink.kill();
            uplink = uplink.restart();
        }
        let before = fill(&uplink).written;
        daemon.send(&document(96, second));
        wait_for("the disk", || fill(&uplink).written > before);
    }
    assert_eq!(fill(&uplink).messages, HOUR as u64, "all wait");
    broker.restart();
    wait_for("half of the queue", || fill(&uplink).messages < HOUR as u64 / 2);
    uplink.kill();
    let uplink = uplink.restart();
    wait_for("the rest", || fill(&uplink).messages == 0);
    daemon.send(&document(96, HOUR + 1));
    reader.wait_for_topic_time("packwatch/info", HOUR + 1);
    reader.wait_for_topic_time("packwatch/history", HOUR + 1);

    let messages = reader.messages();
    let samples: Vec<&Value> =
        messages.iter().filter(|(topic, _)| topic == "packwatch/history").map(|(_, value)| value).collect();
    let mut latest = (0, 0);
    for sample in &samples {
        let now = (sample["sequence"].as_i64().unwrap(), rig::second_of(sample));
        // Every sample arrives at least once, and no sample is skipped. Each message has the next sample, or repeats an
        // earlier sample.
        assert!(now.1 <= latest.1 + 1, "after second {} came {}", latest.1, now.1);
        latest = latest.max(now);
    }
    assert_eq!((latest.1, samples.len() >= HOUR as usize), (HOUR + 1, true));
    // Each power cut repeats at most 20 samples, the largest number of unacknowledged samples.
    assert!(samples.len() <= HOUR as usize + 2 + 2 * 20, "{} samples", samples.len());
    let current: Vec<i64> = messages
        .iter()
        .filter(|(topic, _)| topic == "packwatch/info")
        .map(|(_, value)| rig::second_of(value))
        .collect();
    assert!(current.is_sorted(), "a current value is older than one before it: {current:?}");
    // If the reader has not confirmed a message when the connection ends, the broker sends the message again. Both
    // copies have the same sequence number, so the set keeps one of them.
    let events: BTreeSet<i64> = messages
        .iter()
        .filter(|(topic, _)| topic == "packwatch/events")
        .map(|(_, event)| event["sequence"].as_i64().unwrap())
        .collect();
    assert_eq!(events, BTreeSet::from([1, 2]), "events of the document, once");
}

#[test]
fn full_queue_drops_oldest_samples_first_and_counts() {
    let (mut broker, daemon) = (Broker::start(""), Daemon::start());
    let reader = Reader::start(&broker, &["packwatch/history", "packwatch/events"]);
    broker.stop();
    let uplink = Uplink::start(&broker, &daemon, &format!("{EAGER}max_messages = 50\n"));
    for second in 0..200 {
        let before = fill(&uplink).written;
        let mut pack = document(2, second);
        pack["events"] = (0..=second / 10)
            .map(|number| serde_json::json!({ "event": "gap", "seconds": number, "time": number }))
            .collect();
        pack["event_count"] = (second / 10 + 1).into();
        daemon.send(&pack);
        wait_for("the disk", || fill(&uplink).written > before);
    }
    assert_eq!(fill(&uplink).messages, 50);
    broker.restart();
    reader.wait_for_messages(50);
    let messages = reader.messages();
    let events: Vec<&Value> = messages
        .iter()
        .filter(|(topic, _)| topic == "packwatch/events")
        .map(|(_, value)| &value["data"]["seconds"])
        .collect();
    assert_eq!(events, (0..20).map(Value::from).collect::<Vec<_>>().iter().collect::<Vec<_>>(), "no event is lost");
    let samples: Vec<i64> = messages
        .iter()
        .filter(|(topic, _)| topic == "packwatch/history")
        .map(|(_, value)| rig::second_of(value))
        .collect();
    assert_eq!(samples, (170..200).collect::<Vec<_>>(), "the newest samples are left");
    wait_for("the count", || {
        let uplink = Reader::retained(&broker, "packwatch/uplink").pop().map(|(_, text)| text).unwrap_or_default();
        uplink
            == "{\"dropped_events\":0,\"dropped_samples\":170,\"missed_events\":0,\"queue_bytes\":0,\"queue_messages\":0}"
    });
}

#[test]
fn burst_of_events_without_broker_is_delivered_or_counted() {
    let (mut broker, daemon) = (Broker::start(""), Daemon::start());
    let reader = Reader::start(&broker, &["packwatch/events"]);
    broker.stop();
    let uplink = Uplink::start(&broker, &daemon, "retry_max_s = 1\n[mqtt.history]\nperiod_s = 0\n");
    // The daemon lists at most 1,024 events: all of a burst of 1,000, and not all of a burst of 2,000.
    for (second, first, last) in [(0, 1, 2), (1, 1, 1002), (2, 1979, 3002)] {
        let mut pack = document(2, second);
        let event = |number: i64| serde_json::json!({ "event": "gap", "seconds": number, "time": number });
        pack["events"] = (first..=last).map(event).collect();
        pack["event_count"] = last.into();
        let before = fill(&uplink).written;
        daemon.send(&pack);
        wait_for("the disk", || fill(&uplink).written > before);
    }
    let _uplink = uplink.restart();
    broker.restart();
    reader.wait_for_messages(2027);
    let numbers: BTreeSet<i64> =
        reader.messages().iter().filter_map(|(_, event)| event["data"]["seconds"].as_i64()).collect();
    assert_eq!(numbers, (1..=1002).chain(1979..=3002).collect());
    let missed: Vec<Value> = reader.messages().iter().map(|(_, event)| event["data"]["missed"].clone()).collect();
    assert_eq!(missed[1002], 976, "in place of the missed events");
    wait_for("the count", || {
        let uplink = Reader::retained(&broker, "packwatch/uplink").pop().map(|(_, text)| text).unwrap_or_default();
        uplink
            == "{\"dropped_events\":0,\"dropped_samples\":0,\"missed_events\":976,\"queue_bytes\":0,\"queue_messages\":0}"
    });
}

#[test]
fn rejected_topic_does_not_stop_others() {
    let folder = tempfile::tempdir().unwrap();
    let rights = folder.path().join("rights");
    fs::write(&rights, "topic read #\ntopic write packwatch/history\ntopic write packwatch/status\n").unwrap();
    let (mut broker, daemon) = (Broker::start(&format!("acl_file {}\n", rights.display())), Daemon::start());
    let reader = Reader::start(&broker, &["packwatch/history", "packwatch/events"]);
    let uplink = Uplink::start(&broker, &daemon, EAGER);
    for second in 0..5 {
        daemon.send(&document(1, second));
        reader.wait_for_topic_time("packwatch/history", second);
    }
    let topics = |reader: &Reader| reader.messages().into_iter().map(|(topic, _)| topic).collect::<Vec<_>>();
    assert!(!topics(&reader).contains(&"packwatch/events".to_owned()));
    let log = uplink.log();
    assert!(log.contains("packwatch/events: the broker rejects the message: NotAuthorized"), "{log}");
    for topic in ["packwatch/events", "packwatch/info", "homeassistant/"] {
        assert!(log.lines().filter(|line| line.contains(topic)).count() <= 1, "once, not each time: {log}");
    }
    assert!(!log.contains("rumqttc"), "the library repeats each rejection: {log}");
    assert_eq!(log.matches("connected broker").count(), 1, "the connection stays: {log}");
    wait_for("the refused events alone", || fill(&uplink).messages == 2);

    broker.stop();
    fs::write(&rights, "topic readwrite #\n").unwrap();
    broker.restart();
    wait_for("the events", || topics(&reader).iter().filter(|topic| *topic == "packwatch/events").count() == 2);
    wait_for("an empty queue", || fill(&uplink).messages == 0);
}

#[test]
fn wrong_password_is_retried_and_wrong_authority_fails() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).display().to_string();
    rig::make_certificates(folder.path());
    fs::write(at("password"), "wrong\n").unwrap();
    rig::make_password_file(folder.path(), "car", "s3cret");
    let (ca, cert, key, passwords) = (at("ca.pem"), at("broker.pem"), at("broker.key"), at("passwords"));
    let broker = Broker::start(&format!(
        "cafile {ca}\ncertfile {cert}\nkeyfile {key}\npassword_file {passwords}\nallow_anonymous false\n"
    ));
    let daemon = Daemon::start();
    let with = |ca: &str| {
        format!(
            "user = \"car\"\npassword_file = \"{}\"\nretry_max_s = 1\n[mqtt.tls]\nca_file = \"{ca}\"\n",
            at("password")
        )
    };
    let uplink = Uplink::start(&broker, &daemon, &with(&ca));
    wait_for("the broker's refusal", || {
        uplink.log().contains("the broker rejects user or password (mqtt.user, mqtt.password_file)")
    });
    std::thread::sleep(Duration::from_millis(2500));
    assert_eq!(
        uplink.log().matches("no connection to the broker").count(),
        1,
        "once, not at each attempt: {}",
        uplink.log()
    );
    // The password ends with a line break, as an editor writes it. The file is read again at each attempt.
    fs::write(at("password"), "s3cret\r\n").unwrap();
    wait_for("a connection", || uplink.log().contains("connected broker"));

    let other = Uplink::start(&broker, &daemon, &with(&at("other.pem")));
    wait_for("the fault of the certificate", || other.log().contains("UnknownIssuer"));
    assert!(!other.log().contains("connected broker"));
}
