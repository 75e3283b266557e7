//! Tests the answers to requests.

use packwatch_host::http::{Method, Request};
use serde_json::json;

use super::*;

fn document() -> StatusDocument {
    serde_json::from_str(include_str!("../tests/data/status.json")).unwrap()
}

fn get(path: &str) -> Result<Value, Fault> {
    let (path, query) = path.split_once('?').unwrap_or((path, ""));
    resources::get(path, query, Some(&document()))
}

#[test]
fn every_listed_resource_can_be_read() {
    let components = get("/v1/components").unwrap();
    let battery = get(components["items"][0]["href"].as_str().unwrap()).unwrap();
    for (list, id) in [("data", "id"), ("faults", "code")] {
        let list = battery[list].as_str().unwrap();
        let items = get(list).unwrap()["items"].as_array().unwrap().clone();
        assert!(!items.is_empty(), "{list}");
        for item in items {
            let found = get(&format!("{list}/{}", item[id].as_str().unwrap())).unwrap();
            assert!(found["id"] == item["id"] && found.get("item").is_none_or(|it| *it == item), "{item} {found}");
        }
    }
    let categories = get("/v1/components/battery/data-categories").unwrap();
    assert_eq!(categories["items"], json!([{ "item": "currentData" }, { "item": "identData" }]));
    assert_eq!(get("/version-info").unwrap()["sovd_info"][0]["base_uri"], "/v1");
}

#[test]
fn data_have_unit_deviation_and_time() {
    let soc = get("/v1/components/battery/data/soc").unwrap();
    let expected =
        json!({ "value": 0.632, "unit": "fraction", "standard_deviation": 0.012, "time": "2027-01-15T08:00:00.000Z" });
    assert_eq!(soc, json!({ "id": "soc", "data": expected }));
    let cells = get("/v1/components/battery/data/cells_voltage_v").unwrap();
    assert_eq!(cells["data"]["value"].as_array().unwrap().len(), document().cells.len());
    assert_eq!(get("/v1/components/battery/data/reported_soc").unwrap()["data"]["value"], Value::Null);
}

#[test]
fn faults_have_code_severity_and_status() {
    let faults = get("/v1/components/battery/faults").unwrap();
    let first = &faults["items"][0];
    assert_eq!(
        (&first["code"], &first["scope"], &first["severity"]),
        (&json!("capacity_low-severe-cell1"), &json!("alarms"), &json!(2))
    );
    assert_eq!(first["status"]["aggregatedStatus"], "active");
    assert_eq!(faults["x-packwatch-not-judged"], json!(["recharge_period_low"]));
    let only =
        |state: &str| get(&format!("/v1/components/battery/faults?status%5BaggregatedStatus%5D={state}")).unwrap();
    let count = |list: &Value| list["items"].as_array().unwrap().len();
    assert_eq!(count(&only("active")) + count(&only("pending")) + count(&only("passive")), count(&faults));
}

#[test]
fn errors_have_status_and_generic_body() {
    let request = |method: Method, path: &str, host: &str| {
        let request = Request::builder().method(method).uri(path).header("host", host).body(()).unwrap();
        answer(&request, None).status().as_u16()
    };
    let local = "127.0.0.1:9560";
    for (status, method, path, host) in [
        (200, Method::GET, "/v1/components/", local),
        (405, Method::PUT, "/v1/components", local),
        (405, Method::DELETE, "/v1/components/battery/faults", local),
        (403, Method::GET, "/v1/components", "evil.example"),
        (404, Method::GET, "/v1/apps", local),
        // The daemon is silent.
        (503, Method::GET, "/v1/components/battery/faults", local),
        (503, Method::GET, "/v1/components/battery/data/soc", local),
    ] {
        assert_eq!(request(method, path, host), status, "{path}");
    }
    for (path, status) in
        [("/faults?severity=1", 400), ("/data?x=1", 400), ("/data/nothing", 404), ("/faults/nothing", 404)]
    {
        let fault = get(&format!("/v1/components/battery{path}")).unwrap_err();
        assert_eq!((fault.status.as_u16(), &fault.body()["error_code"]), (status, &json!("vendor-specific")), "{path}");
    }
}
