//! Writes the passport as JSON: merges the known values into the manufacturer's part, and checks the result against the
//! structure that the standard requires.
//!
//! The [details](details) contain what the standards do not provide for. The manufacturer's part is rejected if it
//! states a value that is also measured, so that each value has one source.

use serde_json::{Map, Value, json};

use super::condition::{Condition, Quantity, RATED_TOLERANCE, Rated};
use super::field::{Field, Place, Standard, rounded};
use super::shape::{Verdict, joined};
use super::standards;

use crate::config::VehicleIdentity;
use crate::io::stamp::format_utc;

/// Merges the known values into the manufacturer's part and checks the result.
///
/// # Errors
/// The manufacturer's part is faulty, or required values are missing. The error has one line per fault with its path,
/// and one line per missing value with the reason.
pub fn passport(standard: Standard, condition: &Condition, manufacturer: Value) -> Result<Value, Vec<String>> {
    let Value::Object(mut root) = manufacturer else {
        return Err(vec!["static part: must be an object".to_owned()]);
    };
    let mut faults = Vec::new();
    let known: Vec<(Field, Place, Quantity)> =
        places(standard).filter_map(|(field, place)| Some((field, place, condition.get(field).ok()?))).collect();
    for (index, (field, place, quantity)) in known.iter().enumerate() {
        faults.extend(insert(&mut root, place.group, place.value, field.number(quantity.value)).err());
        if known[..index].iter().any(|(_, before, _)| before.group == place.group) {
            continue;
        }
        // A group has the time of its oldest value. The temperatures share a group.
        let of_group = known.iter().filter(|(_, other, _)| other.group == place.group);
        let oldest = of_group.map(|(.., quantity)| quantity.time).min().unwrap_or(quantity.time);
        faults.extend(insert(&mut root, place.group, place.time, Value::from(format_utc(oldest))).err());
    }
    if standard == Standard::ProductCondition {
        add_events(&mut root, condition);
    }
    let document = Value::Object(root);
    faults.extend(other_battery(condition.rated(), &document));
    let is_opened = |path: &str| places(standard).any(|(_, place)| path != place.group && is_above(path, place.group));
    let Verdict { faults: wrong, missing } = standards::shape(standard).check(&document, &is_opened);
    faults.extend(wrong);
    faults.extend(missing.iter().map(|path| missing_fault(standard, condition, path)));
    if faults.is_empty() { Ok(document) } else { Err(faults) }
}

/// Returns an empty manufacturer's part: every member of the structure that packwatch does not fill in, with `null` for
/// each value.
pub fn template(standard: Standard) -> Value {
    let places: Vec<String> = places(standard)
        .flat_map(|(_, place)| [joined(place.group, place.value), joined(place.group, place.time)])
        .collect();
    let shape = standards::shape(standard);
    shape.template("", &|path| places.iter().any(|place| place == path)).unwrap_or_default()
}

/// Removes `null` values, and the objects and lists that only contained such values. An empty object or list stays,
/// because the manufacturer wrote it.
pub fn without_nulls(value: Value) -> Option<Value> {
    match value {
        Value::Null => None,
        Value::Object(members) if !members.is_empty() => {
            let known: Map<String, Value> =
                members.into_iter().filter_map(|(name, value)| Some((name, without_nulls(value)?))).collect();
            (!known.is_empty()).then_some(Value::Object(known))
        }
        Value::Array(items) if !items.is_empty() => {
            let known: Vec<Value> = items.into_iter().filter_map(without_nulls).collect();
            (!known.is_empty()).then_some(Value::Array(known))
        }
        other => Some(other),
    }
}

/// Returns every value with its unit, definition, standard deviation and time. For each absent value, returns the
/// reason.
pub fn details(standard: Standard, condition: &Condition, vehicle: &VehicleIdentity) -> Value {
    let (mut values, mut absent) = (Vec::new(), Vec::new());
    for field in Field::ALL {
        let (name, unit, definition) = field.meaning();
        let path = field.place(standard).map(|place| joined(place.group, place.value));
        match condition.get(field) {
            Ok(quantity) => values.push(json!({
                "name": name,
                "path": path,
                "value": rounded(quantity.value),
                "std": quantity.std.map(rounded),
                "unit": unit,
                "time": format_utc(quantity.time),
                "definition": definition,
            })),
            Err(why) => absent.push(json!({ "name": name, "path": path, "reason": why })),
        }
    }
    let vehicle: Map<String, Value> =
        vehicle.labels().into_iter().map(|(key, text)| (key.to_owned(), Value::from(text))).collect();
    json!({
        "version": 1,
        "program": format!("packwatch {}", env!("CARGO_PKG_VERSION")),
        "standard": standard.name(),
        "vehicle": vehicle,
        "values": values,
        "absent": absent,
        "use_record": condition.use_record(),
    })
}

fn places(standard: Standard) -> impl Iterator<Item = (Field, Place)> {
    Field::ALL.into_iter().filter_map(move |field| Some((field, field.place(standard)?)))
}

/// Adds the counted events to the list of negative events. The manufacturer's part may already contain this list.
fn add_events(root: &mut Map<String, Value>, condition: &Condition) {
    let events = condition.events().into_iter();
    let mut events =
        events.map(|(what, time)| json!({ "NegativeEventValue": what, "LastUpdate": format_utc(time) })).peekable();
    if events.peek().is_none() {
        return;
    }
    // If the value is not a list, the check of the structure reports it.
    if let Some(list) = root.entry("NegativeEvents").or_insert_with(|| json!([])).as_array_mut() {
        list.extend(events);
    }
}

fn is_above(path: &str, group: &str) -> bool {
    group.strip_prefix(path).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

fn insert(root: &mut Map<String, Value>, group: &str, name: &str, value: Value) -> Result<(), String> {
    let mut object = root;
    for step in group.split('.') {
        let next = object.entry(step).or_insert_with(|| Value::Object(Map::new()));
        // If the value is not an object, the check of the structure reports it.
        let Some(next) = next.as_object_mut() else { return Ok(()) };
        object = next;
    }
    if object.contains_key(name) {
        let path = joined(group, name);
        return Err(format!(
            "{path}: stated in the static part, but also measured ({value}): remove it from the static part"
        ));
    }
    object.insert(name.to_owned(), value);
    Ok(())
}

/// Returns faults if the rated values belong to another battery. Only Catena-X states rated values.
fn other_battery(rated: Rated, document: &Value) -> impl Iterator<Item = String> {
    let both = [
        ("capacity", rated.capacity_ah, "Ah by the configuration (cell model and strings)"),
        ("energy", rated.energy_kwh, "kWh by --certified-energy-kwh"),
    ];
    both.into_iter().filter_map(|(name, known, source)| {
        let (known, stated) = (known?, document.pointer(&format!("/performance/rated/{name}/value"))?.as_f64()?);
        let is_other = (stated - known).abs() > RATED_TOLERANCE * known.abs();
        is_other.then(|| format!("performance.rated.{name}.value: found {stated}, must be {known} {source}"))
    })
}

fn missing_fault(standard: Standard, condition: &Condition, path: &str) -> String {
    let of_field = places(standard).find(|(_, place)| is_above(path, place.group) || is_above(place.group, path));
    match of_field.map(|(field, _)| condition.get(field)) {
        Some(Err(why)) => format!("{path}: required, but unknown: {why}"),
        _ => format!("{path}: required, but no record contains it: state it with --static"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::passport::condition::Known;
    use crate::quantity::Timestamp;

    fn known(value: f64) -> Known {
        Ok(Quantity { value, std: Some(0.5), time: Timestamp::from_secs(1.7e9) })
    }

    fn condition(absent: &[Field]) -> Condition {
        let value = |field: Field| {
            let is_absent = absent.contains(&field);
            (field, if is_absent { Err("no reading".to_owned()) } else { known(12.75) })
        };
        Condition::of(Field::ALL.map(value).to_vec(), Rated { capacity_ah: Some(4.0), energy_kwh: Some(0.014) })
    }

    #[test]
    fn values_are_in_their_places_with_times() {
        let built =
            passport(Standard::ProductCondition, &condition(&[]), json!({ "InformationOnAccidents": [] })).unwrap();
        let cycles = json!({ "NumberOfFullCyclesValue": 12, "LastUpdate": "2023-11-14T22:13:20Z" });
        assert_eq!(built["NumberOfFullCycles"], cycles);
        assert_eq!(built["TemperatureInformation"]["MeasuredTemp"], 12.75);
        assert_eq!(built.as_object().unwrap().len(), 9, "{built}");
    }

    #[test]
    fn unknown_required_value_is_rejected() {
        let accidents = || json!({ "InformationOnAccidents": ["report-1"] });
        let absent = [Field::StateOfCertifiedEnergy, Field::EnergyThroughput];
        let built = passport(Standard::ProductCondition, &condition(&absent), accidents()).unwrap();
        assert!(built.get("StateOfCertifiedEnergy").is_none() && built.get("EnergyThroughput").is_none(), "{built}");
        let refused =
            passport(Standard::ProductCondition, &condition(&[Field::StateOfCharge]), accidents()).unwrap_err();
        assert_eq!(refused, ["StateOfCharge: required, but unknown: no reading"]);
        let refused = passport(Standard::ProductCondition, &condition(&[]), json!({})).unwrap_err();
        assert_eq!(refused, ["InformationOnAccidents: required, but no record contains it: state it with --static"]);
    }

    #[test]
    fn measured_value_in_the_static_part_is_rejected() {
        let stated = json!({ "InformationOnAccidents": [], "StateOfCharge": { "StateOfChargeValue": 50 } });
        let refused = passport(Standard::ProductCondition, &condition(&[]), stated).unwrap_err();
        assert_eq!(
            refused,
            [
                "StateOfCharge.StateOfChargeValue: stated in the static part, but also measured (12.75): remove it from the static part"
            ]
        );
        let temperatures =
            json!({ "InformationOnAccidents": [], "TemperatureInformation": { "TimeExtremeHighTemp": 4.5 } });
        let built = passport(Standard::ProductCondition, &condition(&[Field::TimeHot]), temperatures).unwrap();
        assert_eq!(built["TemperatureInformation"]["TimeExtremeHighTemp"], 4.5, "both parts of one group");
    }

    #[test]
    fn missing_parts_of_a_battery_pass_are_listed_once() {
        let refused =
            passport(Standard::BatteryPass, &condition(&[Field::StateOfCertifiedEnergy]), json!({})).unwrap_err();
        let has = |line: &str| refused.iter().any(|fault| fault == line);
        assert!(has("materials: required, but no record contains it: state it with --static"), "{refused:?}");
        assert!(has("performance.dynamic.energy.soce: required, but unknown: no reading"), "{refused:?}");
        assert!(
            has("performance.dynamic.power: required, but no record contains it: state it with --static"),
            "{refused:?}"
        );
        assert!(!refused.iter().any(|fault| fault.contains("fullCycles")), "{refused:?}");
    }

    #[test]
    fn static_part_of_another_battery_is_rejected() {
        let faults = |capacity: f64, energy: f64| {
            let rated = json!({ "capacity": { "value": capacity }, "energy": { "value": energy } });
            let stated = json!({ "performance": { "rated": rated } });
            let refused = passport(Standard::BatteryPass, &condition(&[]), stated).unwrap_err();
            refused.into_iter().filter(|fault| fault.contains(": found ")).collect::<Vec<String>>()
        };
        assert_eq!(faults(3.97, 0.0141), Vec::<String>::new(), "rounded");
        let both = faults(60.0, 22.0);
        assert_eq!(
            both[0],
            "performance.rated.capacity.value: found 60, must be 4 Ah by the configuration (cell model and strings)"
        );
        assert_eq!(both[1], "performance.rated.energy.value: found 22, must be 0.014 kWh by --certified-energy-kwh");
    }

    #[test]
    fn details_have_deviations_and_reasons() {
        let details = details(Standard::BatteryPass, &condition(&[Field::PackResistance]), &VehicleIdentity::default());
        let first = &details["values"][0];
        assert_eq!(
            (&first["name"], &first["value"], &first["std"]),
            (&json!("full_cycles"), &json!(12.75), &json!(0.5))
        );
        assert_eq!(first["path"], "performance.dynamic.fullCycles.value");
        assert_eq!(details["absent"][0]["reason"], "no reading");
    }
}
