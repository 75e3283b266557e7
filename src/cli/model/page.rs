//! `packwatch model show`: a cell model in tables. Every "±" is one standard deviation.

use serde::Serialize;

use crate::cell::{CellModel, Chemistry, ModelBands, advise};
use crate::cli::common::output;
use crate::config::cell_model::{KnownBy, LearnedFrom, MeasuredRange, SourcedModel, state_words};
use crate::io::stamp::format_utc;
use crate::monitor::{ModelChange, ModelState};

/// Number of steps of the printed curve: one row every 5 % of SOC.
const CURVE_STEPS: u32 = 20;
/// SOC of the resistance columns.
const RESISTANCE_SOC: [f64; 5] = [0.1, 0.3, 0.5, 0.7, 0.9];

#[derive(Debug, Serialize)]
pub(super) struct ModelPage {
    version: u32,
    source: String,
    state: ModelState,
    name: String,
    chemistry: Option<String>,
    rated_capacity_ah: f64,
    capacity_ah: f64,
    capacity_std_ah: f64,
    voltage_min_v: f64,
    voltage_max_v: f64,
    measured: MeasuredRange,
    data: Option<String>,
    licence: Option<String>,
    learned: Option<LearnedRow>,
    curve: Vec<CurveRow>,
    resistances: Vec<ResistanceRow>,
    soc_error_points: Option<f64>,
    advice: Vec<AdviceRow>,
}

#[derive(Debug, Serialize)]
struct LearnedRow {
    fits: u32,
    changes: Vec<ChangeRow>,
    residual_v: Option<f64>,
    /// A chemistry that fits the voltages better than the chemistry on the label.
    chemistry: Option<Chemistry>,
    soc_share: f64,
    soc_ranges: Vec<[f64; 2]>,
    temperature_ranges_c: Vec<[f64; 2]>,
}

#[derive(Debug, Serialize)]
struct ChangeRow {
    time: String,
    state: ModelState,
    capacity_ah: Option<f64>,
    capacity_std_ah: Option<f64>,
    residual_v: Option<f64>,
    taken_back: bool,
}

#[derive(Debug, Serialize)]
struct CurveRow {
    soc: f64,
    ocv_v: f64,
    ocv_std_v: Option<f64>,
    slope_v: f64,
    soc_std_at_rest: Option<f64>,
    soc_std_under_load: Option<f64>,
    known_by: KnownBy,
}

#[derive(Debug, Serialize)]
struct ResistanceRow {
    temperature_c: f64,
    /// Settled resistance (after a long time at constant current) at each SOC of the table.
    settled: Vec<SettledResistance>,
    /// Series resistance at half charge (ohm).
    r0_ohm: f64,
    /// Resistance (ohm) and time constant (s) of each branch at half charge.
    branches: Vec<BranchPart>,
    known_by: KnownBy,
}

#[derive(Debug, Serialize)]
struct SettledResistance {
    soc: f64,
    ohm: f64,
    /// Standard deviation, fraction.
    std: f64,
}

#[derive(Debug, Serialize)]
struct BranchPart {
    r_ohm: f64,
    tau_s: f64,
}

#[derive(Debug, Serialize)]
struct AdviceRow {
    measurement: String,
    left_points: f64,
}

impl ModelPage {
    /// Creates the page of a model. `name` is shown as the model's source.
    pub(super) fn new(name: String, sourced: &SourcedModel) -> Self {
        let SourcedModel { model, source } = sourced;
        let bands = ModelBands::new(model);
        let (soc_error_points, advice) = advise(&bands).unzip();
        let advice = advice
            .unwrap_or_default()
            .into_iter()
            .map(|advice| AdviceRow { measurement: advice.measurement.to_string(), left_points: advice.left_points });
        Self {
            version: 1,
            source: name,
            state: source.state,
            name: model.name.clone(),
            chemistry: source.chemistry.clone(),
            rated_capacity_ah: model.rated_capacity_ah,
            capacity_ah: model.capacity_ah,
            capacity_std_ah: bands.capacity_std() * model.capacity_ah,
            voltage_min_v: model.voltage_min_v,
            voltage_max_v: model.voltage_max_v,
            measured: source.measured,
            data: source.citation().map(str::to_owned),
            licence: source.licence().map(str::to_owned),
            learned: source.learned.as_ref().map(LearnedRow::new),
            curve: (0..=CURVE_STEPS)
                .map(|k| curve_row(sourced, &bands, f64::from(k) / f64::from(CURVE_STEPS)))
                .collect(),
            resistances: model.temperature_c.iter().map(|&t| resistance_row(sourced, &bands, t)).collect(),
            soc_error_points,
            advice: advice.collect(),
        }
    }

    pub(super) fn text(&self) -> String {
        let mut page = self.head();
        page.push_str("\nopen-circuit voltage at 25 \u{b0}C; \u{b1} is one standard deviation, load is C/2\n");
        let heads = [
            "SOC, %",
            "V",
            "\u{b1} mV",
            "mV per %",
            "SOC at rest \u{b1} points",
            "under load \u{b1} points",
            "known by",
        ];
        page.push_str(&output::table(&heads, self.curve.iter().map(CurveRow::cells), 0));
        page.push_str("\nresistance once settled, m\u{3a9} \u{b1} %, by SOC\n");
        let soc = RESISTANCE_SOC.iter().map(|soc| format!("{:.0} %", 100.0 * soc));
        let heads: Vec<String> = ["\u{b0}C".to_owned()].into_iter().chain(soc).chain(["known by".to_owned()]).collect();
        page.push_str(&output::table(&heads, self.resistances.iter().map(ResistanceRow::settled_cells), 0));
        page.push_str("\nparts of the resistance at half charge, m\u{3a9}\n");
        let branches = self.resistances.first().map_or(0, |row| row.branches.len());
        let parts = (1..=branches).flat_map(|k| [format!("branch {k}"), "tau, s".to_owned()]);
        let heads: Vec<String> = ["\u{b0}C".to_owned(), "series".to_owned()].into_iter().chain(parts).collect();
        page.push_str(&output::table(&heads, self.resistances.iter().map(ResistanceRow::parts), 0));
        let changes = self.learned.iter().flat_map(|learned| &learned.changes);
        if changes.clone().next().is_some() {
            page.push_str("\nlatest changes of the model\n");
            let heads = ["time", "state", "capacity, Ah", "residuals, mV", ""];
            page.push_str(&output::table(&heads, changes.map(ChangeRow::cells), 2));
        }
        page.push_str(&self.verdict());
        page
    }

    fn head(&self) -> String {
        let stated = |text: &Option<String>| text.clone().unwrap_or_else(|| "not stated".to_owned());
        let range = |range: Option<[f64; 2]>, unit: &str, factor: f64| {
            let words =
                |[low, high]: [f64; 2]| format!("{:.0} to {:.0} {unit}", factor * low + 0.0, factor * high + 0.0);
            range.map_or("not stated".to_owned(), words)
        };
        let mut rows = vec![
            ("from", format!("{}: {}", self.source, state_words(self.state))),
            ("chemistry", stated(&self.chemistry)),
            (
                "capacity",
                format!(
                    "{:.3} \u{b1} {:.3} Ah, rated {} Ah",
                    self.capacity_ah, self.capacity_std_ah, self.rated_capacity_ah
                ),
            ),
            ("voltages", format!("{} to {} V", self.voltage_min_v, self.voltage_max_v)),
        ];
        if self.state == ModelState::Given {
            let MeasuredRange { temperature_c, soc, current_a } = self.measured;
            rows.push((
                "measured",
                format!(
                    "temperature {}, SOC {}, current {}",
                    range(temperature_c, "\u{b0}C", 1.0),
                    range(soc, "%", 100.0),
                    range(current_a, "A", 1.0)
                ),
            ));
            rows.push(("data", stated(&self.data)));
            rows.push(("licence", stated(&self.licence)));
        }
        rows.extend(self.learned.iter().flat_map(LearnedRow::rows));
        let rows = rows.into_iter().map(|(key, value)| vec![key.to_owned(), value]);
        format!("{}\n{}", self.name, output::table::<&str>(&[], rows, 2))
    }

    /// Describes the expected SOC error, and the most useful measurements.
    fn verdict(&self) -> String {
        let Some(points) = self.soc_error_points else {
            return "\nexpected error of the SOC in use: unknown, because the model states no error; `packwatch fit` writes one\n"
                .to_owned();
        };
        let mut text = format!("\nexpected error of the SOC in use: about {points:.1} points\n");
        match self.advice.is_empty() {
            true => text.push_str("no single measurement would reduce it much\n"),
            false => text.push_str("most useful measurements, and the error that remains\n"),
        }
        let rows = self
            .advice
            .iter()
            .map(|row| vec![format!("  {}", row.measurement), format!("{:.1} points", row.left_points)]);
        text.push_str(&output::table::<&str>(&[], rows, 1));
        text
    }
}

impl LearnedRow {
    fn new(learned: &LearnedFrom) -> Self {
        Self {
            fits: learned.fits,
            changes: learned.changes.iter().map(ChangeRow::new).collect(),
            residual_v: learned.residual_v,
            chemistry: learned.chemistry,
            soc_share: learned.seen.soc_share(),
            soc_ranges: learned.seen.soc_ranges(),
            temperature_ranges_c: learned.seen.temperature_ranges_c(),
        }
    }

    fn rows(&self) -> Vec<(&'static str, String)> {
        let residual =
            self.residual_v.map_or("nothing fitted yet".to_owned(), |v| format!("residuals {:.1} mV", 1e3 * v));
        let seen = match self.soc_ranges.is_empty() {
            true => "nothing yet".to_owned(),
            false => {
                format!(
                    "SOC {}, temperature {}",
                    ranges(&self.soc_ranges, 100.0, "%"),
                    ranges(&self.temperature_ranges_c, 1.0, "\u{b0}C")
                )
            }
        };
        let mut rows = vec![("fits", format!("{}, {residual}", self.fits)), ("seen", seen)];
        rows.extend(self.chemistry.map(|better| ("fits better", better.name().to_owned())));
        rows
    }
}

impl ChangeRow {
    fn new(change: &ModelChange) -> Self {
        Self {
            time: format_utc(change.time),
            state: change.state,
            capacity_ah: change.capacity.map(|it| it.mean),
            capacity_std_ah: change.capacity.map(|it| it.std()),
            residual_v: change.residual_v,
            taken_back: change.is_taken_back,
        }
    }

    fn cells(&self) -> Vec<String> {
        let capacity = self.capacity_ah.zip(self.capacity_std_ah);
        let note = if self.taken_back { "the previous model is restored" } else { "" };
        vec![
            self.time.clone(),
            state_words(self.state).to_owned(),
            capacity.map_or("the label's".to_owned(), |(mean, std)| format!("{mean:.3} \u{b1} {std:.3}")),
            self.residual_v.map_or(String::new(), |v| format!("{:.1}", 1e3 * v)),
            note.to_owned(),
        ]
    }
}

/// Formats ranges: "10 to 40, 60 to 100 %".
fn ranges(ranges: &[[f64; 2]], factor: f64, unit: &str) -> String {
    let words = ranges.iter().map(|[low, high]| format!("{:.0} to {:.0}", factor * low, factor * high));
    format!("{} {unit}", words.collect::<Vec<_>>().join(", "))
}

impl CurveRow {
    fn cells(&self) -> Vec<String> {
        let of = |value: Option<f64>, factor: f64| {
            value.map_or("unknown".to_owned(), |value| format!("{:.1}", factor * value))
        };
        vec![
            format!("{:.0}", 100.0 * self.soc),
            format!("{:.3}", self.ocv_v),
            of(self.ocv_std_v, 1e3),
            format!("{:.1}", 10.0 * self.slope_v),
            of(self.soc_std_at_rest, 100.0),
            of(self.soc_std_under_load, 100.0),
            self.known_by.words().to_owned(),
        ]
    }
}

impl ResistanceRow {
    fn settled_cells(&self) -> Vec<String> {
        let settled = self.settled.iter().map(|at| format!("{} \u{b1} {:.0}", milliohm(at.ohm), 100.0 * at.std));
        let temperature = [self.temperature_c.to_string()].into_iter();
        temperature.chain(settled).chain([self.known_by.words().to_owned()]).collect()
    }

    fn parts(&self) -> Vec<String> {
        let branches = self.branches.iter().flat_map(|part| [milliohm(part.r_ohm), format!("{:.0}", part.tau_s)]);
        [self.temperature_c.to_string(), milliohm(self.r0_ohm)].into_iter().chain(branches).collect()
    }
}

/// Formats a resistance in milliohm with about three significant digits.
fn milliohm(ohm: f64) -> String {
    let value = 1e3 * ohm;
    let decimals = (2.0 - value.abs().log10().floor()).clamp(0.0, 4.0) as usize;
    format!("{value:.decimals$}")
}

fn curve_row(sourced: &SourcedModel, bands: &ModelBands<'_>, soc: f64) -> CurveRow {
    CurveRow {
        soc,
        ocv_v: bands.ocv_v(soc),
        ocv_std_v: bands.curve_std_v(soc),
        slope_v: bands.slope_v(soc),
        soc_std_at_rest: bands.rest_soc_std(soc),
        soc_std_under_load: bands.load_soc_std(soc, crate::cell::model_bands::CURVE_C),
        known_by: sourced.curve_known_by(soc),
    }
}

fn resistance_row(sourced: &SourcedModel, bands: &ModelBands<'_>, temperature_c: f64) -> ResistanceRow {
    let model: &CellModel = &sourced.model;
    let settled = RESISTANCE_SOC.map(|soc| SettledResistance {
        soc,
        ohm: model.settled_ohm(&model.grid_position(soc, temperature_c)),
        std: bands.resistance(soc, temperature_c).std(),
    });
    // Series resistance and branches are shown at half charge.
    let position = model.grid_position(0.5, temperature_c);
    let part =
        |i: usize| BranchPart { r_ohm: model.branch_r_ohm(i, &position), tau_s: model.branch_tau_s(i, &position) };
    ResistanceRow {
        temperature_c,
        settled: settled.into(),
        r0_ohm: model.r0_ohm(&position),
        branches: (0..model.branches.len()).map(part).collect(),
        known_by: sourced.resistances_known_by(temperature_c),
    }
}
