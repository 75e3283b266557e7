//! Compares discovery messages with the rules of Home Assistant, and tests the availability of entities.

use std::collections::BTreeSet;

use super::*;

/// Device classes of Home Assistant that the messages use, and the units that Home Assistant accepts for each class.
const CLASSES: &[(&str, &[&str])] = &[
    ("energy", &["Wh", "kWh"]),
    ("energy_storage", &["Wh", "kWh"]),
    ("battery", &["%"]),
    ("current", &["A", "mA"]),
    ("data_size", &["B", "kB", "MB"]),
    ("duration", &["d", "h", "min", "s"]),
    ("power", &["W", "kW"]),
    ("temperature", &["°C", "°F", "K"]),
    ("voltage", &["V", "mV"]),
];

fn document() -> StatusDocument {
    serde_json::from_str(include_str!("../../tests/data/status.json")).unwrap()
}

#[test]
fn messages_match_home_assistant_rules() {
    let settings = MqttSettings { topic: "fleet/Bus 12".to_owned(), ..MqttSettings::default() };
    let (mut ids, mut topics) = (BTreeSet::new(), BTreeSet::new());
    for Message { topic, text, is_retained } in messages(&settings, &document()) {
        let config: Value = serde_json::from_str(&text).unwrap();
        let levels: Vec<&str> = topic.split('/').collect();
        let is_word = |text: &&str| text.chars().all(|c| c.is_ascii_alphanumeric() || "_-".contains(c));
        assert!(is_retained && levels.len() == 5 && levels[2..4].iter().all(is_word), "{topic}");
        assert_eq!((levels[0], levels[2], levels[4]), ("homeassistant", "fleet_Bus_12", "config"));
        for key in ["name", "unique_id", "state_topic", "value_template", "availability", "device", "origin"] {
            assert!(!config[key].is_null(), "{topic}: {key}");
        }
        assert_eq!(config["device"]["identifiers"], json!(["fleet_Bus_12"]), "one device");
        let class = config["device_class"].as_str();
        match (levels[1], class) {
            ("binary_sensor", class) => assert_eq!(class, Some("problem")),
            ("sensor", Some("timestamp")) => {
                assert!(config.get("state_class").is_none() && config.get("unit_of_measurement").is_none())
            }
            ("sensor", Some(class)) => {
                let (_, units) =
                    CLASSES.iter().find(|(known, _)| *known == class).unwrap_or_else(|| panic!("{topic}: {class}"));
                assert!(units.contains(&config["unit_of_measurement"].as_str().unwrap()), "{topic}");
                let state = if class == "energy" { "total_increasing" } else { "measurement" };
                assert_eq!(config["state_class"], state, "{topic}");
            }
            ("sensor", None) => {}
            other => panic!("{topic}: {other:?}"),
        }
        assert!(ids.insert(config["unique_id"].clone().to_string()) && topics.insert(topic.clone()), "{topic} twice");
    }
}

#[test]
fn pack_entity_needs_daemon_and_uplink_entity_does_not() {
    let all = messages(&MqttSettings::default(), &document());
    let availability = |key: &str| {
        let topic = format!("homeassistant/sensor/packwatch/{key}/config");
        let message = all.iter().find(|message| message.topic == topic).unwrap_or_else(|| panic!("{topic}"));
        let config: Value = serde_json::from_str(&message.text).unwrap();
        (config["availability"].clone(), config["availability_mode"].clone())
    };
    let both = json!([{ "topic": "packwatch/status" }, { "topic": "packwatch/daemon" }]);
    for key in ["SOC", "SOC_std", "state_of_health", "cell_voltage2", "event", "battery_current"] {
        assert_eq!(availability(key), (both.clone(), json!("all")), "{key}");
    }
    assert_eq!(availability("queue_messages").0, json!([{ "topic": "packwatch/status" }]));
}

#[test]
fn only_soc_is_battery_and_details_are_off() {
    let all = messages(&MqttSettings::default(), &document());
    let configs: Vec<Value> = all.iter().map(|message| serde_json::from_str(&message.text).unwrap()).collect();
    let keys = |is_so: &dyn Fn(&Value) -> bool| -> Vec<&str> {
        let chosen = configs.iter().filter(|config| is_so(config));
        chosen.map(|config| config["unique_id"].as_str().unwrap().trim_start_matches("packwatch_")).collect()
    };
    assert_eq!(keys(&|config| config["device_class"] == "battery"), ["SOC_real", "SOC"]);
    let is_off = |config: &Value| config["enabled_by_default"] == false;
    let off = keys(&is_off);
    for key in ["battery_voltage_cell1", "SOC_std", "state_of_health_std", "late_ticks"] {
        assert!(off.contains(&key), "{key}: {off:?}");
    }
    for key in ["SOC", "state_of_health", "alarm_capacity_low", "event", "dropped_events", "missed_events"] {
        assert!(!off.contains(&key), "{key}: {off:?}");
    }
}
