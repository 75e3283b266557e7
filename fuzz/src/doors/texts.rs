//! Fuzz entry points for texts that are parsed as a whole: DBC, requests of the control socket, OBDb signal sets and
//! BPX files.

use packwatch::can::dbc::Database;
use packwatch::control::protocol::{AlarmList, CommandOutcome, Request, contents};

/// Parses a DBC file. A written DBC must read back unchanged.
pub fn dbc(data: &[u8]) {
    let Ok(database) = Database::parse_bytes(data) else { return };
    let written = database.to_dbc();
    let again = Database::parse(&written)
        .unwrap_or_else(|error| panic!("the written DBC does not read back: {error}\n{written}"));
    assert_eq!(again.to_dbc(), written, "the written DBC reads back differently");
}

/// Parses the bytes as a line from a client and as a line from a daemon.
pub fn control(data: &[u8]) {
    if let Ok(request) = Request::parse(data) {
        let line = request.to_line();
        let again = Request::parse(line.trim_end().as_bytes());
        assert_eq!(again.as_ref(), Ok(&request), "{line}");
    }
    let _ = contents::<AlarmList>(data);
    let _ = contents::<CommandOutcome>(data);
    if let Ok(document) = packwatch::status::client::parse(data) {
        packwatch::status::metrics::openmetrics(Some(document));
    }
}

/// Converts a signal set of OBDb.
#[cfg(feature = "lab")]
pub fn obdb(data: &[u8]) {
    use packwatch::lab::import::obdb::{ObdbSettings, import};
    let Ok(text) = std::str::from_utf8(data) else { return };
    let _ = import(text, &ObdbSettings { source: "fuzz.json".to_owned(), ..ObdbSettings::default() });
}

/// Converts a BPX file. The converted model must be accepted.
#[cfg(feature = "lab")]
pub fn bpx(data: &[u8]) {
    use packwatch::lab::import::bpx::{BpxSettings, import};
    let Ok(text) = std::str::from_utf8(data) else { return };
    let settings = BpxSettings { source: "fuzz.json".to_owned(), name: None };
    if let Ok(made) = import(text, &settings) {
        let read = super::files::with_file("cell.toml", made.text.as_bytes(), packwatch::config::cell_model::load);
        assert!(read.is_ok(), "the written model is rejected: {:?}\n{}", read.err(), made.text);
    }
}
