//! Writes a configuration with the best candidate signals for each quantity of the pack. If the user must first answer
//! questions, returns these questions instead.
//!
//! The configuration contains everything that the log determines, and lists the remaining decisions: the cell model,
//! the assignment of sensors to cells, limits and alarms. The sign of the current and the number of cells are never
//! guessed. If the log does not show them, they become questions.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use super::capture::{AnswerKey, Capture};
use super::fields;
use super::log_signal::{LogSignal, MessageField, SignalOrigin};
use super::signals::Descriptions;
use super::{Candidate, Discovery, PositiveDirection, raw};
use crate::can::CanId;
use crate::cell::Label;
use crate::fit::quoted;
use crate::import::{DiagnosticSignal, DiagnosticTable, series};
use crate::wiring::evidence::{HIDDEN_SOC, PackQuantity};

/// Text for a quantity without a candidate signal. Names the next step.
const NO_CANDIDATE: &str =
    "no signal in the log looks like it: give the DBC file that describes it with --dbc, or a log of a drive";

/// Decisions of the user.
#[derive(Debug, Clone, Default)]
pub struct PackSettings {
    /// Name of the log, for the first line of the configuration.
    pub source: String,
    /// Paths of the DBC files as the configuration names them, in the order in which the files were added.
    pub databases: Vec<String>,
    /// Path, as the configuration names it, of the DBC that is written for the fields that no given DBC describes.
    pub own_database: String,
    /// Path of the cell model as the configuration names it; `None` if the label describes the cell.
    pub cell_model: Option<String>,
    /// Direction of a positive current; needed if the log does not show it.
    pub positive: Option<PositiveDirection>,
}

/// A configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PackConfiguration {
    /// TOML.
    pub text: String,
    /// Text of a DBC with the fields that no given DBC describes. It must be saved under the path in
    /// [`PackSettings::own_database`].
    pub database: Option<String>,
    /// Questions that the user must answer because the log does not answer them.
    pub open: Vec<String>,
}

struct Selection<'a> {
    current: &'a Candidate,
    positive: PositiveDirection,
    voltage: &'a Candidate,
    cells: u16,
    temperature: Option<&'a Candidate>,
    reported: Vec<(&'static str, &'a Candidate)>,
}

pub(super) struct Writer<'a> {
    pub(super) discovery: &'a Discovery,
    pub(super) capture: &'a Capture,
    pub(super) descriptions: &'a Descriptions,
    pub(super) settings: &'a PackSettings,
}

impl Writer<'_> {
    pub(super) fn write(&self) -> Result<PackConfiguration, Vec<String>> {
        let selection = self.select()?;
        let mut open = Vec::new();
        if let Some(cells) = self.descriptions.label.cells.filter(|cells| *cells != selection.cells) {
            let found = selection.cells;
            open.push(format!("the label says {cells} cells in series, the log has {found}: which one is right?"));
        }
        if self.is_raw(selection.current) {
            open.push(format!(
                "the scale of {} is a guess, and the capacity depends on it: compare it with a known current",
                selection.current.signal
            ));
        }
        let mut text = self.head(&selection);
        self.inputs(&selection, &mut text, &mut open);
        self.tables(&selection, &mut text, &mut open);
        self.limits(&selection, &mut text);
        if let Some(model) = &self.settings.cell_model {
            open.push(format!("cell_model = {model:?}: is it this cell?"));
        }
        open.push("which alarms, which limits of current and temperature? see the reference of keys".to_owned());
        let mut known = BTreeSet::new();
        open.retain(|question: &String| known.insert(question.clone()));
        text.push_str("\n# Not decided by the log:\n");
        for question in &open {
            let _ = writeln!(text, "# - {}", plain(question));
        }
        let fields = self.fields(&selection);
        let database = (!fields.is_empty()).then(|| fields::database(&fields).to_dbc());
        Ok(PackConfiguration { text, database, open })
    }

    fn fields(&self, selection: &Selection<'_>) -> Vec<&MessageField> {
        let members = self.candidates(selection).into_iter().flat_map(|candidate| &candidate.members);
        let found = members.filter_map(|index| match &self.signal(*index).origin {
            SignalOrigin::Field(field) => Some(&**field),
            SignalOrigin::Dbc(_) | SignalOrigin::Defined(_) | SignalOrigin::Raw(..) => None,
        });
        found.collect()
    }

    fn best(&self, quantity: PackQuantity) -> Option<&Candidate> {
        self.discovery.candidates.iter().find(|candidate| candidate.quantity == quantity)
    }

    fn select(&self) -> Result<Selection<'_>, Vec<String>> {
        let mut questions = Vec::new();
        let current = self.best(PackQuantity::Current);
        if current.is_none() {
            questions.push(format!("which signal is the pack current? {NO_CANDIDATE}"));
        }
        let positive = self.settings.positive.or(current.and_then(|current| current.positive));
        if let (Some(current), None) = (current, positive) {
            questions.push(format!(
                "what does a positive value of {} mean? the voltage does not show it: give --positive charge or discharge",
                current.signal
            ));
        }
        let groups =
            self.discovery.candidates.iter().filter(|candidate| candidate.quantity == PackQuantity::CellVoltage);
        let cells = groups.filter_map(|group| Some((group, self.row(group)?))).next();
        let pack = self.best(PackQuantity::PackVoltage);
        let stated = self.descriptions.label.cells;
        let voltage = match (cells, pack, stated) {
            (Some((group, count)), _, _) => Some((group, count)),
            (None, Some(pack), Some(count)) => Some((pack, count)),
            (None, Some(pack), None) => {
                let (low, high) = self.fitting_cells(pack);
                questions.push(format!(
                    "how many cells are in series? {} of {:.0} to {:.0} V: {low} to {high} fit; give --label 96s",
                    pack.signal, pack.low, pack.high
                ));
                None
            }
            (None, None, _) => {
                questions.push(format!("which signal is the voltage of the cells or of the pack? {NO_CANDIDATE}"));
                None
            }
        };
        if self.settings.cell_model.is_none() && self.descriptions.label.cell().is_none() {
            questions.push(
                "which cell is it? give --model CELL.toml, or chemistry and capacity from the label, such as --label nmc:64Ah"
                    .to_owned(),
            );
        }
        let (Some(current), Some(positive), Some((voltage, cells)), []) = (current, positive, voltage, &questions[..])
        else {
            return Err(questions);
        };
        // A raw field without a name may be another quantity than a temperature, so it is not used.
        let temperature = self.best(PackQuantity::Temperature).filter(|candidate| !self.is_raw(candidate));
        let soc = self.best(PackQuantity::Soc).map(|candidate| ("reported_soc", candidate));
        let soh = self.best(PackQuantity::Soh).map(|candidate| ("reported_soh", candidate));
        let reported = soc.into_iter().chain(soh).collect();
        Ok(Selection { current, positive, voltage, cells, temperature, reported })
    }

    /// Returns the lowest and highest number of cells in series that make a pack voltage plausible. A known state of
    /// charge narrows the range.
    fn fitting_cells(&self, pack: &Candidate) -> (u32, u32) {
        let label = &self.descriptions.label;
        let (mut low_v, mut high_v) = (3.0, 4.2);
        let model =
            label.chemistry.and_then(|chemistry| Label::usual(chemistry, label.capacity_ah.unwrap_or(50.0)).model());
        if let Some(model) = model {
            (low_v, high_v) = (model.voltage_min_v, model.voltage_max_v);
            if let Some(soc) = self.best(PackQuantity::Soc) {
                let ocv_v = |soc: f64| model.ocv_v(&model.grid_position(soc.clamp(0.0, 1.0), 25.0));
                // The margins are needed under load, where the voltage differs from the open-circuit voltage.
                (low_v, high_v) =
                    (ocv_v(soc.low / 100.0 - HIDDEN_SOC) - 0.05, ocv_v(soc.high / 100.0 + HIDDEN_SOC) + 0.05);
            }
        }
        ((pack.high / high_v).ceil() as u32, (pack.low / low_v).floor() as u32)
    }

    fn signal(&self, index: usize) -> &LogSignal {
        &self.discovery.log_signals[index]
    }

    fn is_raw(&self, candidate: &Candidate) -> bool {
        let is_raw =
            |index: &usize| matches!(self.signal(*index).origin, SignalOrigin::Raw(..) | SignalOrigin::Field(_));
        candidate.members.iter().any(is_raw)
    }

    /// Returns the number of cells in a group of numbered cell signals. `None` if the numbers have gaps, or if there
    /// are fewer than two cells.
    fn row(&self, group: &Candidate) -> Option<u16> {
        let numbers = self.numbers(group)?;
        let first = *numbers.first()?;
        let has_no_gap = (first..).zip(&numbers).all(|(expected, number)| expected == *number);
        u16::try_from(numbers.len()).ok().filter(|count| *count >= 2 && has_no_gap)
    }

    fn numbers(&self, group: &Candidate) -> Option<Vec<u32>> {
        let before = group.signal.split_once("{n}").filter(|(before, _)| !before.contains("{m}"));
        let mut numbers = Vec::new();
        for index in &group.members {
            let name = &self.signal(*index).name;
            let rest = match before {
                Some((before, _)) => name.strip_prefix(before)?,
                // If a name has several numbers, the last one is the cell number.
                None => name.rsplit(|c: char| !c.is_ascii_digit()).find(|text| !text.is_empty())?,
            };
            let digits = rest.bytes().take_while(u8::is_ascii_digit).count();
            numbers.push(rest[..digits].parse().ok()?);
        }
        numbers.sort_unstable();
        Some(numbers)
    }

    fn head(&self, selection: &Selection<'_>) -> String {
        let mut text = format!("# Written by `packwatch discover` from {}.\n", plain(&self.settings.source));
        if !self.used_tables(selection).0.is_empty() {
            text.push_str("# Definitions from OBDb (https://github.com/OBDb) are under CC BY-SA 4.0, and so is this file with them.\n");
        }
        let _ = write!(text, "\n[pack]\ncells = {}\n", selection.cells);
        if let Some(model) = &self.settings.cell_model {
            let _ = writeln!(text, "cell_model = {}", quoted(model));
        } else if let Some(label) = self.descriptions.label.cell() {
            let (name, rated_ah) = (label.chemistry.name(), label.rated_ah);
            let _ = write!(text, "chemistry = {}\nrated_capacity_ah = {rated_ah}\n", quoted(name));
        }
        for interface in self.interfaces(selection) {
            let _ = write!(text, "\n[[interface]]\nname = {}\n", quoted(interface));
        }
        text
    }

    fn candidates<'s>(&self, selection: &'s Selection<'_>) -> Vec<&'s Candidate> {
        let reported = selection.reported.iter().map(|(_, candidate)| *candidate);
        [selection.current, selection.voltage].into_iter().chain(selection.temperature).chain(reported).collect()
    }

    fn interfaces<'s>(&self, selection: &'s Selection<'_>) -> Vec<&'s str> {
        let mut names: Vec<&str> = self.candidates(selection).iter().map(|found| found.interface.as_str()).collect();
        names.sort_unstable();
        names.dedup();
        names
    }

    fn inputs(&self, selection: &Selection<'_>, text: &mut String, open: &mut Vec<String>) {
        let mut files: Vec<String> = Vec::new();
        for candidate in self.candidates(selection) {
            for index in &candidate.members {
                if let SignalOrigin::Dbc(file) = self.signal(*index).origin {
                    files.extend(self.settings.databases.get(file).map(|name| quoted(name)));
                }
            }
        }
        let fields = self.fields(selection);
        if !fields.is_empty() {
            files.push(quoted(&self.settings.own_database));
            let names: BTreeSet<String> = fields.iter().map(|field| fields::message_name(field.id)).collect();
            let names = names.into_iter().collect::<Vec<_>>().join(", ");
            open.push(format!("{names}: found by their values alone, are they right? compare with the dashboard"));
        }
        files.sort_unstable();
        files.dedup();
        let _ = write!(text, "\n[input]\ndbc = [{}]\n", files.join(", "));
        let positive = format!("positive = \"{}\"\n", selection.positive.name());
        self.input("[input.current]", selection.current, &selection.current.signal, &positive, text);
        let first = self.numbers(selection.voltage).and_then(|numbers| numbers.first().copied()).unwrap_or(1);
        match selection.voltage.quantity {
            PackQuantity::CellVoltage => {
                let first = format!("first = {first}\n");
                self.input("[input.cell_voltage]", selection.voltage, &selection.voltage.signal, &first, text);
                self.compare_sum(selection, open);
            }
            _ => self.input("[input.pack_voltage]", selection.voltage, &selection.voltage.signal, "", text),
        }
        match selection.temperature {
            Some(temperature) => {
                let name = self.signal(temperature.members[0]).name.clone();
                self.input("[[input.temperature]]", temperature, &name, "", text);
                if temperature.signals > 1 {
                    open.push(format!(
                        "{} has {} sensors, only {name} is used: which cells are near which sensor?",
                        temperature.signal, temperature.signals
                    ));
                }
            }
            None => open.push("no temperature: [pack] ambient_c is assumed".to_owned()),
        }
        for (key, candidate) in &selection.reported {
            self.input(&format!("[input.{key}]"), candidate, &candidate.signal, "", text);
        }
    }

    fn input(&self, table: &str, candidate: &Candidate, signal: &str, more: &str, text: &mut String) {
        let _ = write!(text, "\n# {}\n{table}\nsignal = {}\n", plain(&candidate.reasons.join("; ")), quoted(signal));
        let _ = write!(text, "interface = {}\n{more}", quoted(&candidate.interface));
        let (mut scale, offset) = self.signal(candidate.members[0]).conversion;
        // A scale in the configuration replaces the factor 0.01 for percent.
        if scale != 1.0 && matches!(candidate.quantity, PackQuantity::Soc | PackQuantity::Soh) {
            scale *= 0.01;
        }
        for (key, value) in [("scale", scale), ("offset", offset)] {
            if value != if key == "scale" { 1.0 } else { 0.0 } {
                let _ = writeln!(text, "{key} = {value}");
            }
        }
    }

    fn compare_sum(&self, selection: &Selection<'_>, open: &mut Vec<String>) {
        let Some(pack) = self.best(PackQuantity::PackVoltage) else { return };
        let sum: f64 = selection.voltage.members.iter().map(|index| self.signal(*index).series.extent.mean()).sum();
        let pack_v = self.signal(pack.members[0]).series.extent.mean();
        if (pack_v / sum - 1.0).abs() > 0.05 {
            open.push(format!(
                "{} is {pack_v:.1} V, but the sum of the cells is {sum:.1} V: are all cells included?",
                pack.signal
            ));
        }
    }

    /// Returns two lists. The first contains the given definitions of diagnostic answers, reduced to the selected
    /// signals. The second contains, for each kind of answer, the selected fields that no definition describes.
    fn used_tables(
        &self,
        selection: &Selection<'_>,
    ) -> (Vec<DiagnosticTable>, BTreeMap<AnswerKey, Vec<DiagnosticSignal>>) {
        let mut names: BTreeMap<usize, Vec<&str>> = BTreeMap::new();
        let mut fields: BTreeMap<AnswerKey, Vec<DiagnosticSignal>> = BTreeMap::new();
        for index in self.candidates(selection).iter().flat_map(|candidate| &candidate.members) {
            let signal = self.signal(*index);
            match &signal.origin {
                SignalOrigin::Defined(table) => names.entry(*table).or_default().push(&signal.name),
                SignalOrigin::Raw(key, field) => fields.entry(*key).or_default().push((**field).clone()),
                SignalOrigin::Dbc(_) | SignalOrigin::Field(_) => {}
            }
        }
        let table = |(index, used): (usize, Vec<&str>)| {
            let mut table = self.descriptions.tables.get(index)?.clone();
            let name = table.name.clone();
            let is_used = |signal: &DiagnosticSignal| {
                (0..signal.count()).any(|n| used.contains(&format!("{name}.{}", signal.of_series(n).name).as_str()))
            };
            table.signals.retain(is_used);
            table.remarks.clear();
            for signal in &mut table.signals {
                let full_name = format!("{name}.{}", signal.name);
                if self.discovery.log_signals.iter().any(|other| other.is_read_signed && other.name == full_name) {
                    *signal = signal.as_signed();
                    table
                        .remarks
                        .push(format!("{} is unsigned in the source, but its values are signed.", signal.name));
                }
            }
            Some(table)
        };
        (names.into_iter().filter_map(table).collect(), fields)
    }

    fn tables(&self, selection: &Selection<'_>, text: &mut String, open: &mut Vec<String>) {
        let (tables, fields) = self.used_tables(selection);
        for table in tables {
            let _ = write!(text, "\n{table}");
        }
        for (key, mut signals) in fields {
            signals.sort_by_key(|signal| signal.bit);
            let heard = self.capture.answers.get(&key).and_then(|answers| answers.request);
            let request = heard.map_or_else(|| guessed_request(key.response), |(id, _)| id);
            let mut remarks = vec!["Without a definition: positions and scales come from plausible values.".to_owned()];
            if heard.is_none() {
                remarks.push("No request was heard: its identifier is a guess.".to_owned());
                open.push(format!("which identifier requests {}? 0x{:X} is a guess", key.response, request.raw()));
            }
            let first_byte = heard.and_then(|(_, first)| first).unwrap_or_default();
            let table = DiagnosticTable {
                name: raw::table_name(&key),
                request,
                response: key.response,
                extension: key.extension.map(|response| (first_byte, response)),
                service: key.service,
                identifier: key.identifier,
                remarks,
                signals: series::join(signals),
            };
            let names: Vec<&str> = table.signals.iter().map(|signal| signal.name.as_str()).collect();
            let names = names.join(", ");
            open.push(format!(
                "{} {names}: found by their values alone, are they right? compare with the dashboard",
                table.name
            ));
            let _ = write!(text, "\n{table}");
        }
    }

    /// Writes the maximum ages of readings. They follow from the signals' periods in the log, because diagnostic
    /// answers may be many seconds apart.
    fn limits(&self, selection: &Selection<'_>, text: &mut String) {
        let named = [
            ("current", Some(selection.current)),
            ("voltage", Some(selection.voltage)),
            ("temperature", selection.temperature),
        ];
        for (name, candidate) in named {
            let Some(candidate) = candidate else { continue };
            let period_s = candidate
                .members
                .iter()
                .map(|index| self.signal(*index).series.period_s().unwrap_or(0.0))
                .fold(0.0, f64::max);
            // The default for voltages is 2 s.
            let age_s = (3.0 * period_s).max(2.0).ceil();
            let _ = write!(text, "\n[limits.{name}]\nmax_age_s = {age_s:.1}\n");
        }
    }
}

fn guessed_request(response: CanId) -> CanId {
    match response {
        // ISO 15765-4: the identifier of the request is 8 below the identifier of the answer.
        CanId::Standard(id) => CanId::Standard(id.saturating_sub(8)),
        // Normal fixed addressing: request and answer swap the two addresses.
        CanId::Extended(id) => {
            let [low, high, ..] = id.to_le_bytes();
            CanId::Extended(id & !0xFFFF | u32::from(low) << 8 | u32::from(high))
        }
    }
}

/// Replaces control characters by spaces, so that the text stays within one comment line.
fn plain(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}
