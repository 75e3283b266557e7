//! Tests, without a broker, what a connection publishes and in which order.

use super::*;

fn document() -> StatusDocument {
    serde_json::from_str(include_str!("../../tests/data/status.json")).unwrap()
}

fn topics(messages: &[Message]) -> Vec<&str> {
    messages.iter().map(|message| message.topic.as_str()).collect()
}

#[test]
fn discovery_repeats_on_change_and_removes_old_entities() {
    let settings = MqttSettings::default();
    let mut published = PublishedState::default();
    let mut document = document();
    let first = published.news(&settings, Some(&document), Fill::default());
    assert!(first.len() > 50 && first.iter().all(|message| message.is_retained), "{}", first.len());
    let values = ["packwatch/info", "packwatch/spec_data"];
    assert_eq!(topics(&published.news(&settings, Some(&document), Fill::default())), values);
    document.cells.pop();
    let news = published.news(&settings, Some(&document), Fill::default());
    let gone: Vec<&Message> = news.iter().filter(|message| message.text.is_empty()).collect();
    assert_eq!(gone, [&Message::retained("homeassistant/sensor/packwatch/cell_voltage2/config".to_owned(), "")]);
}

#[test]
fn daemon_is_online_after_values_and_offline_without() {
    let mut settings = MqttSettings::default();
    settings.discovery.enabled = false;
    let mut published = PublishedState::default();
    let fill = Fill::default();
    assert_eq!(
        topics(&published.news(&settings, None, fill)),
        ["packwatch/daemon", "packwatch/uplink", "packwatch/status"]
    );
    let news = published.news(&settings, Some(&document()), fill);
    assert_eq!(topics(&news), ["packwatch/info", "packwatch/spec_data", "packwatch/daemon"]);
    assert_eq!(news[2].text, "online");
    let news = published.news(&settings, None, Fill { messages: 1, ..fill });
    assert_eq!(topics(&news), ["packwatch/daemon", "packwatch/uplink"]);
    assert_eq!(news[0].text, "offline");
}

#[test]
fn uplink_is_online_after_values_before_discovery() {
    let mut published = PublishedState::default();
    let news = published.news(&MqttSettings::default(), Some(&document()), Fill::default());
    let place = |topic: &str| topics(&news).iter().position(|it| *it == topic).unwrap();
    let first_of_discovery = topics(&news).iter().position(|topic| topic.starts_with("homeassistant/")).unwrap();
    assert!(
        place("packwatch/info") < place("packwatch/daemon") && place("packwatch/daemon") < place("packwatch/status")
    );
    assert!(place("packwatch/status") < first_of_discovery);
}
