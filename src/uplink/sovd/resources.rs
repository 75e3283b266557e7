//! Converts a path and a status document to a resource of the component `battery`, as JSON.
//!
//! Data have the units of the status document. `null` = unknown. Faults are the findings, and the alarms that need
//! attention. Cells count from 1.

use packwatch_host::alarm::{Alarm, AlarmState, Severity};
use packwatch_host::cell_faults::CellFault;
use packwatch_host::http::StatusCode;
use packwatch_host::quantity::catalogue::{CellValues, PackValues, Part, Presentation, Quantity, QuantityRow};
use packwatch_host::status::document::StatusDocument;
use serde_json::{Value, json};

use crate::mqtt::entity::{stamp, word};

const COMPONENT: &str = "/v1/components/battery";
/// Query parameter that selects the faults with one state.
const FILTER: &str = "status[aggregatedStatus]";

/// A request that cannot be answered, as SOVD's generic error.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Fault {
    pub(super) status: StatusCode,
    code: &'static str,
    message: String,
}

impl Fault {
    fn new(status: StatusCode, code: &'static str, message: impl Into<String>) -> Self {
        Self { status, code, message: message.into() }
    }

    pub(super) fn read_only() -> Self {
        Self::new(StatusCode::METHOD_NOT_ALLOWED, "read-only", "must be GET or HEAD")
    }

    pub(super) fn foreign_host() -> Self {
        Self::new(StatusCode::FORBIDDEN, "foreign-host", "the header Host must be a numeric address or localhost")
    }

    fn missing(message: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not-found", message)
    }

    /// The body of the answer. SOVD defines an error code only for a component that does not respond.
    pub(super) fn body(&self) -> Value {
        let Self { status, code, message } = self;
        if *status == StatusCode::SERVICE_UNAVAILABLE {
            return json!({ "error_code": code, "message": message });
        }
        json!({ "error_code": "vendor-specific", "vendor_code": code, "message": message })
    }
}

/// Returns the resource at `path`. `document` is `None` if the daemon is silent.
pub(super) fn get(path: &str, query: &str, document: Option<&StatusDocument>) -> Result<Value, Fault> {
    let path = path.strip_suffix('/').unwrap_or(path);
    let present = || {
        let silent = || Fault::new(StatusCode::SERVICE_UNAVAILABLE, "not-responding", "the daemon reports no status");
        document.ok_or_else(silent)
    };
    let below = |name: &str| path.strip_prefix(COMPONENT)?.strip_prefix(name)?.strip_prefix('/');
    match path {
        _ if !query.is_empty() && path != format!("{COMPONENT}/faults") => Err(unknown_query(query)),
        "/version-info" => Ok(json!({ "sovd_info": [{ "version": "1.0", "base_uri": "/v1",
            "vendor_info": { "name": "packwatch", "version": env!("CARGO_PKG_VERSION") } }] })),
        "/v1/components" => Ok(json!({ "items": [{ "id": "battery", "name": "Battery pack", "href": COMPONENT }] })),
        COMPONENT => Ok(json!({ "id": "battery", "name": "Battery pack", "data": format!("{COMPONENT}/data"),
            "data-categories": format!("{COMPONENT}/data-categories"), "faults": format!("{COMPONENT}/faults") })),
        _ if below("/data").is_some() => {
            let (id, document) = (below("/data").unwrap_or_default(), present()?);
            let item = items().find(|item| item.id == id);
            item.map(|item| item.value(document)).ok_or_else(|| Fault::missing(format!("no data {id}")))
        }
        _ if below("/faults").is_some() => {
            let (code, document) = (below("/faults").unwrap_or_default(), present()?);
            let fault = faults(document).into_iter().find(|fault| fault["code"] == code);
            let fault = fault.ok_or_else(|| Fault::missing(format!("no fault {code}")))?;
            Ok(json!({ "item": fault }))
        }
        _ => match path.strip_prefix(COMPONENT) {
            Some("/data") => Ok(json!({ "items": items().map(|item| item.entry()).collect::<Vec<_>>() })),
            Some("/data-categories") => Ok(json!({ "items": [{ "item": "currentData" }, { "item": "identData" }] })),
            Some("/faults") => fault_list(query, present()?),
            _ => Err(Fault::missing(format!("no resource {path}; begin with /v1/components"))),
        },
    }
}

fn unknown_query(query: &str) -> Fault {
    Fault::new(StatusCode::BAD_REQUEST, "unknown-query", format!("query {query}: must be {FILTER}=active on faults"))
}

struct Item {
    id: String,
    name: String,
    source: Source,
}

enum Source {
    Pack(&'static QuantityRow),
    Cells(&'static QuantityRow),
    Identity(IdentityOf),
}

type IdentityOf = fn(&StatusDocument) -> Value;

fn items() -> impl Iterator<Item = Item> {
    let item = |prefix: &str, row: &'static QuantityRow, it: &Presentation, source: Source| Item {
        id: format!("{prefix}{}", row.key),
        name: it.about.to_owned(),
        source,
    };
    let pack = PackValues::rows().map(move |(row, it)| item("", row, it, Source::Pack(row)));
    let cells = CellValues::rows().map(move |(row, it)| item("cells_", row, it, Source::Cells(row)));
    let identity = |(id, name, value): (&str, &str, IdentityOf)| Item {
        id: id.to_owned(),
        name: name.to_owned(),
        source: Source::Identity(value),
    };
    let identities: [(&str, &str, IdentityOf); 4] = [
        ("vehicle_id", "Identification number of the vehicle", |it| json!(it.vehicle.id)),
        ("vehicle_name", "Name of the vehicle", |it| json!(it.vehicle.name)),
        ("pack_name", "Name of the pack", |it| json!(it.vehicle.pack)),
        ("software_version", "Version of packwatch", |it| json!(it.program_version)),
    ];
    pack.chain(cells).chain(identities.map(identity))
}

impl Item {
    fn entry(&self) -> Value {
        let category = if matches!(self.source, Source::Identity(_)) { "identData" } else { "currentData" };
        json!({ "id": self.id, "name": self.name, "category": category })
    }

    fn value(&self, document: &StatusDocument) -> Value {
        let of_row = |row: &QuantityRow, value: &dyn Fn(Quantity, Part) -> Value| {
            let mut data = json!({ "value": value(row.quantity, Part::Mean), "unit": row.unit.symbol() });
            if row.std_key.is_some() {
                data["standard_deviation"] = value(row.quantity, Part::Std);
            }
            data
        };
        let mut data = match self.source {
            Source::Pack(row) => of_row(row, &|quantity, part| json!(document.pack.values.part(quantity, part))),
            Source::Cells(row) => of_row(row, &|quantity, part| {
                document.cells.iter().map(|cell| json!(cell.values.part(quantity, part))).collect()
            }),
            Source::Identity(value) => json!({ "value": value(document) }),
        };
        data["time"] = stamp(document.wall_time).into();
        json!({ "id": self.id, "data": data })
    }
}

/// The list of faults. The `x-` keys state how many alarms the list omits and which rules could not be judged, so that
/// a short list does not look healthy.
fn fault_list(query: &str, document: &StatusDocument) -> Result<Value, Fault> {
    let decoded = query.replace("%5B", "[").replace("%5b", "[").replace("%5D", "]").replace("%5d", "]");
    let state = match decoded.split_once('=') {
        None if query.is_empty() => None,
        Some((FILTER, state)) if ["active", "pending", "passive"].contains(&state) => Some(state),
        _ => return Err(unknown_query(query)),
    };
    let is_wanted = |fault: &Value| state.is_none_or(|state| fault["status"]["aggregatedStatus"] == state);
    let unknown: Vec<String> = document.alarms.unknown.iter().map(|it| it.rule.name().to_owned()).collect();
    Ok(json!({
        "items": faults(document).into_iter().filter(is_wanted).collect::<Vec<_>>(),
        "x-packwatch-omitted": document.alarms.omitted,
        "x-packwatch-not-judged": unknown,
    }))
}

fn faults(document: &StatusDocument) -> Vec<Value> {
    let alarms = document.alarms.list.iter().map(alarm);
    alarms.chain(document.findings.iter().map(finding)).collect()
}

fn alarm(alarm: &Alarm) -> Value {
    let (rule, severity) = (alarm.rule.name(), alarm.severity.name());
    let cell = alarm.cell.map(|cell| u32::from(cell.0) + 1);
    let state = match alarm.state {
        state if state.is_raised() => "active",
        AlarmState::Pending => "pending",
        _ => "passive",
    };
    let place = cell.map_or_else(String::new, |cell| format!(" of cell {cell}"));
    json!({
        "code": format!("{rule}-{severity}{}", cell.map_or_else(String::new, |cell| format!("-cell{cell}"))),
        "scope": "alarms",
        "fault_name": format!("{}{place}, threshold {}", rule.replace('_', " "), alarm.rule.with_unit(alarm.threshold)),
        // SOVD: 1 fatal, 2 error, 3 warning, 4 information.
        "severity": match alarm.severity { Severity::Severe => 2, Severity::Warning => 3, Severity::Info => 4 },
        "status": {
            "aggregatedStatus": state,
            "state": word(&alarm.state),
            "acknowledged": alarm.is_acknowledged.to_string(),
            "occurrences": alarm.occurrences.to_string(),
        },
    })
}

fn finding(finding: &CellFault) -> Value {
    let cells = finding.cells.map_or_else(String::new, |(first, last)| {
        if first == last { format!("-cell{}", first.0 + 1) } else { format!("-cell{}-cell{}", first.0 + 1, last.0 + 1) }
    });
    json!({
        "code": format!("{}{cells}", finding.kind.name()),
        "scope": "findings",
        "fault_name": finding.to_string(),
        "severity": 3,
        "status": { "aggregatedStatus": "active" },
    })
}
