//! Cell model files: TOML to a checked [`CellModel`], with every fault at once.
//!
//! A model is refused unless breakpoints rise strictly, SOC runs from 0 to 1, the open-circuit voltage rises
//! strictly with SOC at every temperature, tables have no hole, and resistances, capacitances and capacities
//! are positive.
//!
//! | file | content |
//! | --- | --- |
//! | `source` | where a model comes from |
//! | `write` | a model as a file |
//! | `library` | the files in the usual folders |

pub mod library;
mod source;
mod write;

use std::path::Path;

use toml::Spanned;
use toml::de::DeValue;

use super::document::{Document, Faults, TablePlace};
use super::schema::Presence::{Optional, Required};
use super::schema::{SchemaReader, Section as _, SectionInfo, section};
use super::setting::ValueRange::{Above, Any, Between, NotEmpty};
use super::setting::{Setting, ValueFault, ValueRange, in_range, typed};
use super::{ConfigFaults, ConfigFiles, ReadFile, Sources};
use crate::cell::{
    AgedOcv, Branch, CellModel, Electrodes, MAX_BRANCHES, ModelSpread, NegativeMaterial, PositiveMaterial, Table,
    Thermal,
};
use crate::monitor::ModelState;
pub use source::{KnownBy, LearnedFrom, MeasuredRange, ModelSource, SourcedModel, state_words};
pub use write::text;

const INF: f64 = f64::INFINITY;

section! {
    /// A cell type.
    Head at "" {
        /// Version of this layout.
        format: u16, "", Between(1.0, 1.0), Required;
        /// Name of the cell, for people.
        name: String, "", NotEmpty, Required;
        /// Chemistry, for people.
        chemistry: Option<String>, "", NotEmpty, Optional;
        /// Capacity on the label, which SOH is relative to.
        rated_capacity_ah: f64, "Ah", Above(0.0, 1e5), Required;
        /// Charge of a new cell from full to empty open-circuit voltage.
        capacity_ah: f64, "Ah", Above(0.0, 1e5), Required;
        /// How far the open-circuit curve shifts as the cell loses capacity, where `[electrodes]` does not say it: 0 = it shrinks evenly over SOC; 1 = the top keeps its ampere-hours and the empty end comes sooner. Without either: 0.
        ocv_ageing_shift: Option<f64>, "", Between(0.0, 1.0), Optional;
        /// Lowest voltage under load.
        voltage_min_v: f64, "V", Above(0.0, 100.0), Required;
        /// Highest voltage under charge.
        voltage_max_v: f64, "V", Above(0.0, 100.0), Required;
    }
}

section! {
    /// The circuit over SOC and temperature. Two-dimensional tables have one row per temperature and one column per SOC.
    Tables at "tables" {
        /// SOC breakpoints, strictly rising from 0 to 1.
        soc: Vec<f64>, "fraction", Between(0.0, 1.0), Required;
        /// Temperature breakpoints, strictly rising.
        temperature_c: Vec<f64>, "degrees C", Between(-100.0, 200.0), Required;
        /// Open-circuit voltage, strictly rising along each row.
        ocv_v: Vec<Vec<f64>>, "V", Above(0.0, 100.0), Required;
        /// Series resistance of a new cell.
        r0_ohm: Vec<Vec<f64>>, "ohm", Above(0.0, INF), Required;
        /// Standard deviation of the model's voltage error, averaged over 100 s, as `packwatch fit` determines it. Without it: the estimator's `model_error_v_sqrt_s`.
        voltage_error_v: Option<Vec<Vec<f64>>>, "V", Above(0.0, 10.0), Optional;
    }
}

section! {
    /// Where the cell was measured, as `packwatch fit` writes it. For people: beyond these temperatures the tables of a fit continue with larger `voltage_error_v`, so that estimates are less certain there.
    Measured at "measured" {
        /// Lowest and highest temperature. Without it: not known.
        temperature_c: Option<Vec<f64>>, "degrees C", Between(-100.0, 200.0), Optional;
        /// Lowest and highest current; positive = discharge. Without it: not known.
        current_a: Option<Vec<f64>>, "A", Between(-1e6, 1e6), Optional;
        /// Lowest and highest state of charge. Without it: not known.
        soc: Option<Vec<f64>>, "fraction", Between(-1.0, 2.0), Optional;
    }
}

section! {
    /// A branch of a resistor and a capacitor in parallel, 1 to 3 of them.
    BranchTables at "tables.branches" gives Branch, |keys| {
        /// Resistance of a new cell.
        r_ohm: Vec<Vec<f64>>, "ohm", Above(0.0, INF), Required => r_ohm: Table { values: keys.r_ohm.clone() };
        /// Capacitance.
        c_farad: Vec<Vec<f64>>, "F", Above(0.0, INF), Required => c_farad: Table { values: keys.c_farad.clone() };
    }
}

section! {
    /// The electrodes of the new cell, as `packwatch fit` finds them in a slow test: how the open-circuit curve changes as lithium and active material are lost. The lithium content of an electrode is a fraction of its maximum.
    ElectrodesKeys at "electrodes" gives Electrodes, |keys| {
        /// Material of the positive electrode.
        positive: PositiveMaterial, "", Any, Required;
        /// Material of the negative electrode.
        negative: NegativeMaterial, "", Any, Required;
        /// Lithium content of the positive electrode of the empty and of the full cell.
        positive_content: Vec<f64>, "fraction", Between(0.0, 1.0), Required => positive_content: ends(&keys.positive_content);
        /// Lithium content of the negative electrode of the empty and of the full cell.
        negative_content: Vec<f64>, "fraction", Between(0.0, 1.0), Required => negative_content: ends(&keys.negative_content);
    }
}

section! {
    /// How far a cell may be from the model, in standard deviations, where it is not of a fit's own type: of a model from a label or of one that the vehicle has learned, as `packwatch model export` writes it. Without it: as cells of one type are.
    SpreadKeys at "spread" gives ModelSpread, |keys| {
        /// Constant error of the open-circuit curve, beside its modes.
        curve_v: f64, "V", Between(0.0, 1.0), Required;
        /// ln(resistance relative to the model).
        log_resistance: f64, "", Between(0.0, 5.0), Required;
        /// Resistance of the slowest branch beside the others.
        slow_branch: f64, "fraction", Between(0.0, 5.0), Required;
        /// Capacity.
        capacity: f64, "fraction", Between(0.0, 1.0), Required;
        /// Voltage drop: fraction of it over one second.
        drop_sqrt_s: f64, "", Between(0.0, 100.0), Required;
        /// Two modes of the open-circuit curve's error, one value per `tables.soc`.
        curve_modes_v: Vec<Vec<f64>>, "V", Between(-1.0, 1.0), Required =>;
    }
}

/// Names of the materials in a cell model.
macro_rules! material {
    ($material:ty) => {
        impl Setting for $material {
            const KIND: &'static str = "one of";
            const CHOICES: &'static [&'static str] = &names(&<$material>::ALL);

            fn read(value: &Spanned<DeValue<'_>>, _: &ValueRange) -> Result<Self, ValueFault> {
                let name = typed(value, value.get_ref().as_str())?;
                in_range(value, Self::ALL.iter().find(|(_, known)| *known == name).map(|(material, _)| *material))
            }
        }
    };
}
material!(PositiveMaterial);
material!(NegativeMaterial);

const fn names<T, const N: usize>(all: &[(T, &'static str); N]) -> [&'static str; N] {
    let mut names = [""; N];
    let mut k = 0;
    while k < N {
        names[k] = all[k].1;
        k += 1;
    }
    names
}

/// The first and the last value; the number of values is checked before.
fn ends(values: &[f64]) -> [f64; 2] {
    [values.first().copied().unwrap_or(f64::NAN), values.last().copied().unwrap_or(f64::NAN)]
}

section! {
    /// The thermal model of one cell; without it there is no fallback for a stale temperature.
    ThermalKeys at "thermal" gives Thermal, |keys| {
        /// Heat capacity.
        heat_capacity_j_per_k: f64, "J/K", Above(0.0, 1e9), Required;
        /// Thermal resistance to the surroundings.
        resistance_k_per_w: f64, "K/W", Above(0.0, 1e9), Required;
    }
}

/// Every table of a cell model file, in the order of the reference page.
pub(super) const SECTIONS: &[SectionInfo] = &[
    SectionInfo::one::<Head>(),
    SectionInfo::notes(
        "provenance",
        "Where the numbers come from. For people; any keys. `packwatch cells` shows `citation` (or `source`) and `licence`.",
    ),
    SectionInfo::one::<Measured>(),
    SectionInfo::one::<Tables>(),
    SectionInfo::many::<BranchTables>(),
    SectionInfo::one::<ElectrodesKeys>(),
    SectionInfo::optional::<SpreadKeys>(),
    SectionInfo::one::<ThermalKeys>(),
];

/// Reads and checks a cell model file.
///
/// # Errors
/// Every fault found, one line each.
pub fn load(path: &Path) -> Result<CellModel, ConfigFaults> {
    load_sourced(path).map(|sourced| sourced.model)
}

/// As [`load`], with where the model comes from.
///
/// # Errors
/// Every fault found, one line each.
pub fn load_sourced(path: &Path) -> Result<SourcedModel, ConfigFaults> {
    let mut faults = Faults::default();
    let model = load_with(path, &super::read_file, &mut faults);
    model.filter(|_| faults.is_empty()).ok_or_else(|| ConfigFaults(faults.into_lines()))
}

/// As [`load_sourced`], through `read`; faults are noted with those of other files.
pub(super) fn load_with(path: &Path, read: ReadFile<'_>, faults: &mut Faults) -> Option<SourcedModel> {
    let sources = Sources::read(&ConfigFiles::alone(path), read, faults)?;
    let document = Document::parse(&sources, faults);
    let mut reader = SchemaReader::new(&document, SECTIONS, faults);
    let head = reader.one::<Head>();
    let measured = reader.optional::<Measured>();
    let tables = reader.one::<Tables>();
    let branches = reader.many::<BranchTables>();
    let electrodes = reader.optional::<ElectrodesKeys>();
    let spread = reader.optional::<SpreadKeys>();
    let thermal = reader.optional::<ThermalKeys>();
    let written = reader.count(BranchTables::PATH);
    if let Some(head) = &head {
        check_head(head, faults);
    }
    if let Some(measured) = &measured {
        check_measured(measured, faults);
    }
    let tables = tables?;
    check_tables(&tables, faults);
    check_branch_count(&tables.place, written, faults);
    check_branches(&tables, &branches, faults);
    if let Some(spread) = &spread {
        check_spread(spread, &tables, faults);
    }
    let head = head?;
    let aged_ocv = aged_ocv(&head, &tables, electrodes.as_ref(), spread.as_ref(), faults);
    let source = ModelSource {
        state: ModelState::Given,
        chemistry: head.chemistry.clone(),
        measured: measured.map_or_else(MeasuredRange::default, |keys| keys.range()),
        provenance: provenance(path, read),
        learned: None,
    };
    let model = CellModel {
        spread: spread.map(|keys| keys.config()),
        ..model(head, tables, aged_ocv, &branches, thermal.as_ref())
    };
    Some(SourcedModel { model, source })
}

/// The notes for people; empty when there are none. The file has been parsed before, so that its faults are noted.
fn provenance(path: &Path, read: ReadFile<'_>) -> toml::Table {
    let text = read(path).ok().and_then(|bytes| String::from_utf8(bytes).ok()).unwrap_or_default();
    let notes = text.parse::<toml::Table>().ok().and_then(|mut table| table.remove("provenance"));
    notes.and_then(|notes| notes.try_into().ok()).unwrap_or_default()
}

impl Measured {
    fn range(&self) -> MeasuredRange {
        let range = |values: &Option<Vec<f64>>| values.as_ref().map(|values| ends(values));
        MeasuredRange {
            temperature_c: range(&self.temperature_c),
            current_a: range(&self.current_a),
            soc: range(&self.soc),
        }
    }
}

/// How the open-circuit curve ages, with the modes of its spread; notes what no cell can have. Only sound tables are used.
fn aged_ocv(
    head: &Head,
    tables: &Tables,
    electrodes: Option<&ElectrodesKeys>,
    spread: Option<&SpreadKeys>,
    faults: &mut Faults,
) -> AgedOcv {
    let mut aged_ocv = ageing(head, tables, electrodes, faults);
    if faults.is_empty()
        && let Some([a, b]) = spread.map(|keys| keys.curve_modes_v.as_slice())
    {
        aged_ocv.add_spread(&[a.clone(), b.clone()]);
    }
    aged_ocv
}

fn ageing(head: &Head, tables: &Tables, electrodes: Option<&ElectrodesKeys>, faults: &mut Faults) -> AgedOcv {
    if !faults.is_empty() {
        return AgedOcv::default();
    }
    let (soc, rows) = (&tables.soc, &tables.ocv_v);
    let Some(keys) = electrodes else {
        return AgedOcv::of_shift(head.ocv_ageing_shift.unwrap_or(0.0), soc, head.capacity_ah, rows);
    };
    if head.ocv_ageing_shift.is_some() {
        head.place.fault(faults, "ocv_ageing_shift", "must not be given together with [electrodes]");
    }
    let (positive, negative) = (&keys.positive_content, &keys.negative_content);
    for (key, contents, rises) in [("positive_content", positive, false), ("negative_content", negative, true)] {
        let [empty, full] = ends(contents);
        if contents.len() != 2 || empty == full || (full > empty) != rises {
            let first = if rises { "lower" } else { "higher" };
            keys.place.fault(faults, key, &format!("must be two numbers, empty and full, the {first} first"));
        }
    }
    if !faults.is_empty() {
        return AgedOcv::default();
    }
    AgedOcv::of_electrodes(&keys.config(), soc, head.capacity_ah, rows).unwrap_or_else(|| {
        keys.place.note(faults, "positive_content", "these electrodes do not say how the cell ages");
        AgedOcv::default()
    })
}

fn model(
    head: Head,
    tables: Tables,
    aged_ocv: AgedOcv,
    branches: &[BranchTables],
    thermal: Option<&ThermalKeys>,
) -> CellModel {
    CellModel {
        name: head.name,
        rated_capacity_ah: head.rated_capacity_ah,
        capacity_ah: head.capacity_ah,
        voltage_min_v: head.voltage_min_v,
        voltage_max_v: head.voltage_max_v,
        soc: tables.soc,
        temperature_c: tables.temperature_c,
        aged_ocv,
        ocv_v: Table { values: tables.ocv_v },
        r0_ohm: Table { values: tables.r0_ohm },
        branches: branches.iter().map(BranchTables::config).collect(),
        voltage_error_v: tables.voltage_error_v.map(|values| Table { values }),
        thermal: thermal.map(|keys| keys.config()),
        spread: None,
    }
}

fn check_head(head: &Head, faults: &mut Faults) {
    if head.voltage_max_v <= head.voltage_min_v {
        let what = format!("must be above voltage_min_v = {}", head.voltage_min_v);
        head.place.fault(faults, "voltage_max_v", &what);
    }
}

fn check_measured(measured: &Measured, faults: &mut Faults) {
    let Measured { temperature_c, current_a, soc, place, .. } = measured;
    for (key, range) in [("temperature_c", temperature_c), ("current_a", current_a), ("soc", soc)] {
        if range.as_ref().is_some_and(|range| range.len() != 2 || range[0] > range[1]) {
            place.fault(faults, key, "must be two numbers, the lower first");
        }
    }
}

fn check_tables(tables: &Tables, faults: &mut Faults) {
    let place = &tables.place;
    if tables.soc.len() < 2 || tables.soc.first() != Some(&0.0) || tables.soc.last() != Some(&1.0) {
        place.fault(faults, "soc", "must begin with 0 and end with 1");
    }
    if tables.temperature_c.is_empty() {
        place.fault(faults, "temperature_c", "must have at least one temperature");
    }
    for (key, values) in [("soc", &tables.soc), ("temperature_c", &tables.temperature_c)] {
        if let Some((a, b)) = first_not_rising(values) {
            place.note(faults, key, &format!("{b} follows {a}, must rise strictly"));
        }
    }
    check_shape(place, "ocv_v", &tables.ocv_v, tables, faults);
    check_shape(place, "r0_ohm", &tables.r0_ohm, tables, faults);
    if let Some(voltage_error_v) = &tables.voltage_error_v {
        check_shape(place, "voltage_error_v", voltage_error_v, tables, faults);
    }
    for (row, t) in tables.ocv_v.iter().zip(&tables.temperature_c) {
        if let Some((a, b)) = first_not_rising(row) {
            place.note(faults, "ocv_v", &format!("{b} follows {a} at {t} degrees C, must rise strictly with soc"));
        }
    }
}

fn check_branch_count(place: &TablePlace, written: usize, faults: &mut Faults) {
    if written == 0 || written > MAX_BRANCHES {
        let what = format!("{written} tables [[tables.branches]], must be 1 to {MAX_BRANCHES}");
        place.note(faults, "branches", &what);
    }
}

fn check_branches(tables: &Tables, branches: &[BranchTables], faults: &mut Faults) {
    for branch in branches {
        check_shape(&branch.place, "r_ohm", &branch.r_ohm, tables, faults);
        check_shape(&branch.place, "c_farad", &branch.c_farad, tables, faults);
    }
}

fn check_spread(spread: &SpreadKeys, tables: &Tables, faults: &mut Faults) {
    let (modes, socs) = (&spread.curve_modes_v, tables.soc.len());
    if modes.len() != 2 || modes.iter().any(|mode_v| mode_v.len() != socs) {
        let counts: Vec<String> = modes.iter().map(|mode_v| mode_v.len().to_string()).collect();
        let what = format!("rows of {} values, must be two rows of {socs}, one value per soc", counts.join(" and "));
        spread.place.note(faults, "curve_modes_v", &what);
    }
}

/// No hole: as many rows as temperatures, as many columns as SOC breakpoints.
fn check_shape(place: &TablePlace, key: &str, rows: &[Vec<f64>], tables: &Tables, faults: &mut Faults) {
    let (temperatures, socs) = (tables.temperature_c.len(), tables.soc.len());
    if rows.len() != temperatures {
        let what = format!("{} rows, must be {temperatures}, one per temperature_c", rows.len());
        place.note(faults, key, &what);
    }
    for (number, row) in (1..).zip(rows) {
        if row.len() != socs {
            let what = format!("row {number} has {} values, must be {socs}, one per soc", row.len());
            place.note(faults, key, &what);
        }
    }
}

/// The first neighbours that do not rise.
fn first_not_rising(values: &[f64]) -> Option<(f64, f64)> {
    values.windows(2).find(|pair| pair[1] <= pair[0]).map(|pair| (pair[0], pair[1]))
}
