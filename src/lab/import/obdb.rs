//! Converts an OBDb signal set (one JSON file per car model) to `[[input.diagnostic]]` tables.
//!
//! The tables are sorted by the identifiers of requests and answers, so the commands of one controller are together.
//! The licence of the source, CC BY-SA 4.0, also applies to the TOML, which states it.
//!
//! Signals are named `NAME.REST`. If all ids of a file start with the same word, REST is the `id` without this word;
//! otherwise, REST is the whole `id`. NAME is [`ObdbSettings::name`]. If no name is given, NAME is the common first
//! word, or `Car` if there is none.
//!
//! A file that is not an OBDb signal set is an error. A command or signal that cannot be converted becomes an
//! [`Exclusion`], and the rest is converted. An unknown field is ignored and causes a warning.

mod address;
mod document;
mod signal;
#[cfg(test)]
mod tests;

use std::collections::HashMap;
use std::fmt::Write as _;

use serde_json::Value;

use super::{DiagnosticSignal, DiagnosticTable, Exclusion, ExclusionReason, ImportResult, series};
use crate::error::LabError;
use crate::io::json::json_fault;
use address::Addresses;
use document::{CommandDocument, SignalDocument, SignalSetDocument};

/// Settings of a conversion.
#[derive(Debug, Clone, Default)]
pub struct ObdbSettings {
    /// Name of the file, for messages and the first comment.
    pub source: String,
    /// Model year. Commands of other years are left out. `None` = all commands are converted.
    pub year: Option<i64>,
    /// Name before the dot of every signal.
    pub name: Option<String>,
}

/// Converts the text of a signal set.
///
/// # Errors
/// The text is not an OBDb signal set, or nothing in it can be converted.
pub fn import(text: &str, settings: &ObdbSettings) -> Result<ImportResult, LabError> {
    let (document, converter) = convert(text, settings)?;
    let Converter { tables, exclusions, warnings, .. } = converter;
    let name = tables.first().map_or("", |table| &table.name);
    let mut result = ImportResult { text: head(name, settings, &document), exclusions, warnings, signals: 0 };
    result.signals = tables.iter().map(DiagnosticTable::signal_count).sum();
    for table in &tables {
        let _ = write!(result.text, "\n{table}");
    }
    result.text.push_str(&tail(&result));
    Ok(result)
}

pub(crate) fn tables(text: &str, settings: &ObdbSettings) -> Result<Vec<DiagnosticTable>, LabError> {
    Ok(convert(text, settings)?.1.tables)
}

fn convert(text: &str, settings: &ObdbSettings) -> Result<(SignalSetDocument, Converter), LabError> {
    let source = &settings.source;
    if let Some(name) = settings.name.as_ref().filter(|name| !is_name(name)) {
        return Err(LabError::Data(format!("name is {name:?}, must be letters, digits and _")));
    }
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let document: SignalSetDocument = serde_json::from_str(text).map_err(|error| {
        let (line, column, fault) = (error.line(), error.column(), json_fault(&error));
        LabError::Data(format!("{source}:{line}:{column}: not an OBDb signal set (JSON): {fault}"))
    })?;
    let mut converter = Converter { year: settings.year, ..Converter::default() };
    converter.convert(&document);
    let Converter { tables, exclusions, .. } = &mut converter;
    if tables.is_empty() {
        let first = exclusions.first().map_or_else(|| "commands is empty".to_owned(), ToString::to_string);
        return Err(LabError::Data(format!(
            "{source}: nothing can be converted, {} left out; {first}",
            exclusions.len()
        )));
    }
    rename(tables, settings.name.as_deref());
    tables.sort_by_key(|table| (table.request, table.response, table.extension));
    Ok((document, converter))
}

fn is_name(text: &str) -> bool {
    !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

#[derive(Debug, Default)]
struct Converter {
    year: Option<i64>,
    tables: Vec<DiagnosticTable>,
    /// Place that first defined each signal id and each request.
    known: HashMap<String, String>,
    exclusions: Vec<Exclusion>,
    warnings: Vec<String>,
}

impl Converter {
    fn convert(&mut self, document: &SignalSetDocument) {
        let fields = document.unknown().into_iter().map(|field| format!("unknown field \"{field}\", ignored"));
        self.warnings.extend(fields);
        for (index, value) in document.commands.iter().enumerate() {
            if let Err(exclusion) = self.command(index, value) {
                self.exclusions.push(exclusion);
            }
        }
        for (index, synthetic) in document.synthetics.iter().enumerate() {
            let id = synthetic.get("id").and_then(Value::as_str).unwrap_or("without id").escape_default();
            let detail = format!("{id}; must be a field of an answer");
            let place = format!("synthetics[{index}]");
            self.exclusions.push(Exclusion { reason: ExclusionReason::Synthetic, place, detail });
        }
    }

    fn command(&mut self, index: usize, value: &Value) -> Result<(), Exclusion> {
        let place = format!("commands[{index}]");
        let exclusion = |reason, detail| Exclusion { reason, place: place.clone(), detail };
        let command: CommandDocument = serde_json::from_value(value.clone())
            .map_err(|error| exclusion(ExclusionReason::InvalidField, error.to_string().escape_debug().to_string()))?;
        let (service, identifier) = request(&command).map_err(|(reason, detail)| exclusion(reason, detail))?;
        let hdr = &command.address.hdr;
        let place = format!("{place} ({} {service:02X} {identifier:04X})", hdr.escape_default());
        let exclusion = |reason, detail| Exclusion { reason, place: place.clone(), detail };
        let fields = command.unknown().into_iter();
        self.warnings
            .extend(fields.map(|field| format!("{place}: unknown field \"{}\", ignored", field.escape_debug())));
        if let (Some(filter), Some(year)) = (&command.filter, self.year)
            && !filter.contains(year)
        {
            return Err(exclusion(ExclusionReason::OtherYear, format!("valid for {filter}, requested {year}")));
        }
        let Addresses { request, response, extension } =
            Addresses::new(&command.address).map_err(|detail| exclusion(ExclusionReason::Address, detail))?;
        let key = format!("{request} {response} {extension:?} {service:02X} {identifier:04X}");
        if let Some(before) = self.known.get(&key) {
            let detail = format!("the same request as {before}; --year may select one of them");
            return Err(exclusion(ExclusionReason::Duplicate, detail));
        }
        self.known.insert(key, place.clone());
        let signals = self.signals(&place, &command.signals);
        if signals.is_empty() {
            return Ok(());
        }
        let remarks = remarks(&command);
        let name = String::new();
        self.tables.push(DiagnosticTable { name, request, response, extension, service, identifier, remarks, signals });
        Ok(())
    }

    /// Returns the signals of one command in the order of their bits. A signal that overlaps an earlier signal is left
    /// out.
    fn signals(&mut self, place: &str, values: &[Value]) -> Vec<DiagnosticSignal> {
        let mut signals: Vec<DiagnosticSignal> = Vec::new();
        for (index, value) in values.iter().enumerate() {
            let id = value.get("id").and_then(Value::as_str).unwrap_or("without id").escape_default();
            let place = format!("{place}.signals[{index}] ({id})");
            match self.signal(&place, value, &signals) {
                Ok(signal) => signals.push(signal),
                Err((reason, detail)) => self.exclusions.push(Exclusion { reason, place, detail }),
            }
        }
        signals.sort_by_key(|signal| signal.bit);
        signals
    }

    fn signal(
        &mut self,
        place: &str,
        value: &Value,
        others: &[DiagnosticSignal],
    ) -> Result<DiagnosticSignal, (ExclusionReason, String)> {
        let document: SignalDocument = serde_json::from_value(value.clone())
            .map_err(|error| (ExclusionReason::InvalidField, error.to_string().escape_debug().to_string()))?;
        let fields = document.unknown().into_iter();
        self.warnings
            .extend(fields.map(|field| format!("{place}: unknown field \"{}\", ignored", field.escape_debug())));
        let signal = signal::convert(&document)?;
        let overlaps =
            |other: &&DiagnosticSignal| signal.bit < other.bit + other.length && other.bit < signal.bit + signal.length;
        if let Some(other) = others.iter().find(overlaps) {
            let detail = format!(
                "bits {} to {}, {} has {} to {}",
                signal.bit,
                signal.bit + signal.length - 1,
                other.name,
                other.bit,
                other.bit + other.length - 1
            );
            return Err((ExclusionReason::Overlap, detail));
        }
        if let Some(before) = self.known.get(&signal.name) {
            return Err((
                ExclusionReason::Duplicate,
                format!("id already used by {before}; --year may select one of them"),
            ));
        }
        self.known.insert(signal.name.clone(), place.to_owned());
        Ok(signal)
    }
}

fn request(command: &CommandDocument) -> Result<(u8, u16), (ExclusionReason, String)> {
    let mut entries = command.cmd.iter();
    let (Some((service, identifier)), None) = (entries.next(), entries.next()) else {
        let detail = format!("cmd has {} services, must have one", command.cmd.len());
        return Err((ExclusionReason::InvalidField, detail));
    };
    let (service, digits) = match service.as_str() {
        "01" => (0x01, 2),
        "21" => (0x21, 2),
        "22" => (0x22, 4),
        other => {
            let detail = format!("service {}, must be 01, 21 or 22", other.escape_debug());
            return Err((ExclusionReason::OtherService, detail));
        }
    };
    let is_identifier = identifier.len() == digits && identifier.bytes().all(|c| c.is_ascii_hexdigit());
    let number = u16::from_str_radix(identifier, 16).ok().filter(|_| is_identifier);
    let number = number.ok_or_else(|| {
        let found = identifier.escape_debug();
        let detail =
            format!("identifier is \"{found}\", must be {digits} hexadecimal digits for service {service:02X}");
        (ExclusionReason::InvalidField, detail)
    })?;
    Ok((service, number))
}

fn remarks(command: &CommandDocument) -> Vec<String> {
    let mut remarks = Vec::new();
    if let Some(seconds) = command.freq {
        remarks.push(format!("OBDb polls it every {seconds} s; with [poll], use drive_every_s = {seconds}"));
    }
    if let Some(filter) = &command.filter {
        remarks.push(format!("model years: {filter}"));
    }
    if let Some(session) = &command.din {
        remarks.push(format!("OBDb first enters diagnostic session {}; packwatch never does", session.escape_debug()));
    }
    remarks
}

fn rename(tables: &mut [DiagnosticTable], name: Option<&str>) {
    let first_word = |signal: &DiagnosticSignal| signal.name.split_once('_').map(|(word, _)| word.to_owned());
    let words = tables.iter().flat_map(|table| &table.signals).map(first_word);
    let word = words.reduce(|a, b| if a == b { a } else { None }).flatten().filter(|word| !word.is_empty());
    let name = name.map(str::to_owned).or_else(|| word.clone()).unwrap_or_else(|| "Car".to_owned());
    for table in tables {
        table.name.clone_from(&name);
        for signal in &mut table.signals {
            let short = word.as_ref().and_then(|word| signal.name.strip_prefix(word)?.strip_prefix('_'));
            if let Some(short) = short.filter(|short| !short.is_empty()).map(str::to_owned) {
                signal.name = short;
            }
        }
        table.signals = series::join(std::mem::take(&mut table.signals));
    }
}

fn head(name: &str, settings: &ObdbSettings, document: &SignalSetDocument) -> String {
    let year = settings.year.map_or_else(|| "all model years".to_owned(), |year| format!("model year {year}"));
    let mut text = format!(
        "# Diagnostic inputs, converted by `packwatch import obdb`: {}, {year}.\n\
         # Source: OBDb (https://github.com/OBDb), by the OBDb contributors. Licence of the source, and so of this file:\n\
         # CC BY-SA 4.0 (https://creativecommons.org/licenses/by-sa/4.0/). Changed: form, names, units.\n\
         #\n\
         # A signal is named \"{name}.NAME\" in [input.*]; {{n}} counts through a series. Value = code * factor + offset.\n\
         # Nothing is sent: answers to other testers are decoded. A signal outside minimum and maximum is a bad reading.\n",
        settings.source.escape_debug(),
    );
    if let Some(level) = &document.diagnostic_level {
        let _ = writeln!(
            text,
            "# OBDb uses diagnostic session {}; packwatch never changes the session.",
            level.escape_debug()
        );
    }
    text
}

fn tail(result: &ImportResult) -> String {
    if result.exclusions.is_empty() {
        return String::new();
    }
    let mut text = format!("\n# Left out: {}\n", result.exclusions.len());
    for exclusion in &result.exclusions {
        // Control characters in the file must not end the comment.
        let line: String = exclusion.to_string().chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        let _ = writeln!(text, "# {line}");
    }
    text
}
