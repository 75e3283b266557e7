//! Builds the discovery messages for Home Assistant, which announce the entities and the sources of their values.
//!
//! Input: the daemon's status (cells, rules, vehicle) and the settings. Output: retained messages, one per entity, all
//! for one device. Entities of the pack are available while both the uplink and the daemon are online. Entities of the
//! uplink are available while the uplink is online.

use packwatch_host::status::document::StatusDocument;
use serde_json::{Value, json};

use super::entity::{Kind, entities};
use super::message::Message;
use super::settings::MqttSettings;
use super::topic;

/// Entities of the uplink itself: key in `uplink`, name, unit, device class, state class.
const UPLINK: &[(&str, &str, &str, &str, &str)] = &[
    ("queue_messages", "Uplink Queue Messages", "", "", "measurement"),
    ("queue_bytes", "Uplink Queue Size", "B", "data_size", "measurement"),
    ("dropped_samples", "Uplink Dropped Samples", "", "", "total_increasing"),
    ("dropped_events", "Uplink Dropped Events", "", "", "total_increasing"),
    ("missed_events", "Uplink Missed Events", "", "", "total_increasing"),
];

/// Every discovery message.
pub fn messages(settings: &MqttSettings, document: &StatusDocument) -> Vec<Message> {
    let device = Device::new(settings, document);
    let pack = entities().iter().map(|entity| {
        let mut config = device.entity(&entity.name, &entity.key, topic::INFO, &entity.key);
        describe(&mut config, entity.kind);
        if entity.is_diagnostic {
            config["entity_category"] = "diagnostic".into();
        }
        if !entity.is_enabled {
            config["enabled_by_default"] = false.into();
        }
        device.message("sensor", &entity.key, &config)
    });
    let alarms = document.alarms.rules.iter().map(|rule| device.alarm(rule.name()));
    let cells = if settings.discovery.cells { document.cells.len() } else { 0 };
    let cells = (0..cells).map(|index| device.cell(index));
    let uplink = UPLINK.iter().map(|entity| device.uplink(entity));
    pack.chain(alarms).chain([device.event()]).chain(cells).chain(uplink).collect()
}

fn describe(config: &mut Value, kind: Kind) {
    match kind {
        Kind::Measured { unit, class, decimals } => {
            config["unit_of_measurement"] = unit.into();
            if !class.is_empty() {
                config["device_class"] = class.into();
            }
            config["state_class"] = if class == "energy" { "total_increasing" } else { "measurement" }.into();
            config["suggested_display_precision"] = decimals.into();
        }
        Kind::Number => config["state_class"] = "measurement".into(),
        Kind::Time => config["device_class"] = "timestamp".into(),
        Kind::Word => {}
    }
}

/// Fields shared by all entities.
struct Device<'a> {
    settings: &'a MqttSettings,
    node: String,
    device: Value,
    version: &'a str,
}

impl<'a> Device<'a> {
    fn new(settings: &'a MqttSettings, document: &'a StatusDocument) -> Self {
        let node = settings.node();
        let vehicle = Some(document.vehicle.to_string()).filter(|name| !name.is_empty());
        let name = settings.discovery.device_name.clone().or(vehicle).unwrap_or_else(|| settings.topic.clone());
        let mut device = json!({
            "identifiers": [node],
            "name": name,
            "manufacturer": "packwatch",
            "model": "Battery pack",
            "sw_version": document.program_version,
        });
        if let Some(id) = &document.vehicle.id {
            device["serial_number"] = id.as_str().into();
        }
        Self { settings, node, device, version: &document.program_version }
    }

    /// Builds an entity whose value is at `path` in the JSON of topic `source`.
    fn entity(&self, name: &str, key: &str, source: &str, path: &str) -> Value {
        json!({
            "name": name,
            "unique_id": format!("{}_{key}", self.node),
            "state_topic": self.settings.topic(source),
            "value_template": format!("{{{{ value_json.{path} }}}}"),
            "availability": [
                { "topic": self.settings.topic(topic::STATUS) },
                { "topic": self.settings.topic(topic::DAEMON) },
            ],
            "availability_mode": "all",
            "device": self.device,
            "origin": { "name": "packwatch", "sw_version": self.version },
        })
    }

    fn message(&self, component: &str, key: &str, config: &Value) -> Message {
        let mut config = config.clone();
        config["default_entity_id"] = format!("{component}.{}_{key}", self.node).to_lowercase().into();
        let topic = format!("{}/{component}/{}/{key}/config", self.settings.discovery.prefix, self.node);
        Message::retained(topic, config.to_string())
    }

    fn alarm(&self, rule: &str) -> Message {
        let key = format!("alarm_{rule}");
        let name = format!("Alarm {}", rule.replace('_', " "));
        let mut config = self.entity(&name, &key, topic::INFO, &format!("alarms.{rule}"));
        config["device_class"] = "problem".into();
        // Templates write the JSON values true, false and null as True, False and None.
        config["payload_on"] = "True".into();
        config["payload_off"] = "False".into();
        self.message("binary_sensor", &key, &config)
    }

    /// Returns the entity of a cell's voltage. Its name, topic and identifier are the same as in Battery-Emulator.
    fn cell(&self, index: usize) -> Message {
        let number = index + 1;
        let name = format!("Battery Cell Voltage {number}");
        let key = format!("battery_voltage_cell{number}");
        let mut config = self.entity(&name, &key, topic::CELLS, &format!("cell_voltages_mv[{index}]"));
        describe(&mut config, Kind::Measured { unit: "mV", class: "voltage", decimals: 0 });
        config["enabled_by_default"] = false.into();
        self.message("sensor", &format!("cell_voltage{number}"), &config)
    }

    fn event(&self) -> Message {
        let mut config = self.entity("Event", "event", topic::EVENTS, "message");
        config["json_attributes_topic"] = self.settings.topic(topic::EVENTS).into();
        config["entity_category"] = "diagnostic".into();
        config["icon"] = "mdi:information-outline".into();
        // Home Assistant limits a state to 255 characters.
        config["value_template"] = "{{ value_json.message[:255] }}".into();
        self.message("sensor", "event", &config)
    }

    fn uplink(&self, &(key, name, unit, class, state): &(&str, &str, &str, &str, &str)) -> Message {
        let mut config = self.entity(name, key, topic::UPLINK, key);
        config["availability"] = json!([{ "topic": self.settings.topic(topic::STATUS) }]);
        config["state_class"] = state.into();
        config["entity_category"] = "diagnostic".into();
        if !unit.is_empty() {
            config["unit_of_measurement"] = unit.into();
            config["device_class"] = class.into();
        }
        self.message("sensor", key, &config)
    }
}

#[cfg(test)]
mod tests;
