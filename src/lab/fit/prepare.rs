//! Converts measured files to records for the fit. Determines voltage limits, capacity and temperatures, evaluates slow
//! tests, and assigns an SOC to every row.

use super::FitRequest;
use super::limits::{DISCONNECTED_V, voltage_limits};
use crate::error::LabError;
use crate::ident::ageing;
use crate::ident::fit::{self, FittedTables, OcvCurve, Residual};
use crate::ident::grid::Grid;
use crate::ident::record::{self, Limits, Record};
use crate::measured::{MeasuredFile, MeasuredPart};

/// A credible voltage lies at most this far below the lowest voltage of the cell (first value, V) and above the highest
/// (second value, V).
pub(super) const CREDIBLE_BEYOND_V: (f64, f64) = (1.0, 0.3);
/// Weight of an ageing cell's charge relative to a discharge. It is smaller because relaxation is slower during charge.
const AGEING_CHARGE_SCALE: f64 = 0.6;

/// A part of a file with the SOC of its rows, not yet placed in the grid.
pub(super) struct AnchoredPart {
    pub(super) file: usize,
    part: MeasuredPart,
    judged: Vec<bool>,
    /// Weight of each second of the part; `None` = computed from the covered SOC range and the kind of test.
    scale: Option<f64>,
}

pub(super) struct FitInputs {
    pub(super) sources: Vec<AnchoredPart>,
    pub(super) capacity_ah: f64,
    pub(super) voltage_v: (f64, f64),
    pub(super) ocv: Vec<OcvCurve>,
    pub(super) notes: Vec<String>,
}

/// Removes rows without current or voltage, and rows whose time runs backwards. A missing temperature gets the previous
/// value or, at the start, the first known value.
fn clean(part: &MeasuredPart) -> MeasuredPart {
    let known = part.temperature_c.iter().copied().find(|t| t.is_finite());
    // Assumed for a file without temperatures (degrees Celsius).
    let mut temperature_c = known.unwrap_or(25.0);
    let mut clean = MeasuredPart { key: part.key.clone(), kind: part.kind.clone(), ..MeasuredPart::default() };
    for k in 0..part.len() {
        let backwards = clean.time_s.last().is_some_and(|&last| part.time_s[k] < last);
        if backwards || part.current_a[k].is_nan() || part.voltage_v[k].is_nan() {
            continue;
        }
        if part.temperature_c[k].is_finite() {
            temperature_c = part.temperature_c[k];
        }
        clean.push(part.time_s[k], part.current_a[k], part.voltage_v[k], temperature_c, part.discharged_ah[k]);
    }
    clean
}

pub(super) fn prepare(
    request: &FitRequest,
    files: &[MeasuredFile],
    slow: &[MeasuredFile],
) -> Result<FitInputs, LabError> {
    if request.first_cycles.is_some() {
        need_cycles(files)?;
    }
    let (voltage_v, mut notes) = voltage_limits(request, files, slow)?;
    let dropped: usize = files.iter().map(|f| f.rows() - f.parts.iter().map(|p| clean(p).len()).sum::<usize>()).sum();
    if dropped > 0 {
        notes.push(format!("{dropped} rows left out: current or voltage is missing, or time runs backwards"));
    }
    if let Some(first) = request.first_cycles {
        return ageing_sources(files, first, voltage_v, notes);
    }
    let mut tests = slow.iter().map(|file| slow_test(file, voltage_v.1)).collect::<Result<Vec<_>, _>>()?;
    tests.sort_by(|a, b| a.temperature_c.total_cmp(&b.temperature_c));
    let taken = taken_out(request, files, voltage_v.1)?;
    let deepest_ah = taken.iter().flat_map(|(_, _, out)| out).fold(0.0_f64, |most, ah| most.max(*ah));
    let nearest = tests.iter().min_by(|a, b| (a.temperature_c - 25.0).abs().total_cmp(&(b.temperature_c - 25.0).abs()));
    let capacity_ah = match (request.capacity_ah, nearest) {
        (Some(given), _) => given,
        (None, Some(test)) => {
            notes.push(format!("capacity from the slow test at {:.0} degrees C", test.temperature_c));
            test.out_ah[test.out_ah.len() - 1]
        }
        (None, None) => {
            notes.push("capacity is the deepest discharge in the data (no --capacity given)".into());
            deepest_ah
        }
    };
    if capacity_ah <= 0.0 {
        return Err(LabError::Data("no discharge in the data".into()));
    }
    let sources = taken.into_iter().map(|(file, mut part, out_ah)| {
        part.soc = out_ah.iter().map(|ah| 1.0 - ah / capacity_ah).collect();
        AnchoredPart { file, part, judged: vec![], scale: None }
    });
    let mut sources: Vec<AnchoredPart> = sources.collect();
    let slow_sources =
        slow.iter().enumerate().map(|(k, file)| slow_source(file, files.len() + k, voltage_v.1, capacity_ah));
    sources.extend(slow_sources.collect::<Result<Vec<_>, _>>()?);
    let ocv = tests.iter().map(|test| test.curve(capacity_ah)).collect();
    Ok(FitInputs { sources, capacity_ah, voltage_v, ocv, notes })
}

/// File number, part, and for every row the charge taken out since the cell was full (Ah).
type PartDischarge = (usize, MeasuredPart, Vec<f64>);

/// Returns the charge taken out for every part. One error lists all parts that do not start with a full cell.
fn taken_out(request: &FitRequest, files: &[MeasuredFile], voltage_max_v: f64) -> Result<Vec<PartDischarge>, LabError> {
    let (mut taken, mut refused) = (Vec::new(), Vec::new());
    for (number, file) in files.iter().enumerate() {
        for part in file.parts.iter().map(clean).filter(|part| !part.time_s.is_empty()) {
            let hint_ah = request.capacity_ah.or(request.rated_ah).unwrap_or_else(|| rough_capacity(&part));
            match part.taken_out_ah(voltage_max_v, hint_ah) {
                Ok(out_ah) => taken.push((number, part, out_ah)),
                Err(error) => refused.push(format!("{}{}: {error}", file.path.display(), key_text(&part))),
            }
        }
    }
    if refused.is_empty() { Ok(taken) } else { Err(LabError::Data(refused.join("\n"))) }
}

fn key_text(part: &MeasuredPart) -> String {
    if part.key.is_empty() { String::new() } else { format!(" part {}", part.key) }
}

fn rough_capacity(part: &MeasuredPart) -> f64 {
    let out = crate::ident::charge_ah(&part.time_s, &part.current_a);
    out.iter().fold(0.0_f64, |most, ah| most.max(*ah))
}

struct SlowDischarge {
    temperature_c: f64,
    out_ah: Vec<f64>,
    voltage_v: Vec<f64>,
}

impl SlowDischarge {
    fn curve(&self, capacity_ah: f64) -> OcvCurve {
        let soc = self.out_ah.iter().rev().map(|ah| 1.0 - ah / capacity_ah).collect();
        let voltage_v = self.voltage_v.iter().rev().copied().collect();
        OcvCurve { temperature_c: self.temperature_c, soc, voltage_v }
    }
}

fn slow_test(file: &MeasuredFile, voltage_max_v: f64) -> Result<SlowDischarge, LabError> {
    let fail = |what: String| LabError::Data(format!("{}: {what}", file.path.display()));
    let part = clean(&file.parts[0]);
    if part.time_s.is_empty() {
        return Err(fail("no row with current and voltage".into()));
    }
    let out_ah = part.taken_out_ah(voltage_max_v, rough_capacity(&part)).map_err(fail)?;
    let begin = part.current_a.iter().position(|&i| i > 0.0).ok_or_else(|| fail("no discharge".into()))?;
    let len = part.current_a[begin..].iter().take_while(|&&i| i > 0.0).count();
    let mut test = SlowDischarge { temperature_c: 0.0, out_ah: vec![], voltage_v: vec![] };
    let mut sum_c = 0.0;
    for (k, &ah) in out_ah.iter().enumerate().skip(begin).take(len) {
        if test.out_ah.last().is_none_or(|&last| ah > last) && part.voltage_v[k] > DISCONNECTED_V {
            test.out_ah.push(ah);
            test.voltage_v.push(part.voltage_v[k]);
            sum_c += part.temperature_c[k];
        }
    }
    let whole_ah = out_ah.iter().fold(0.0_f64, |most, ah| most.max(*ah));
    if test.out_ah.len() < 10 || test.out_ah[test.out_ah.len() - 1] < 0.5 * whole_ah {
        return Err(fail(format!("its first discharge has {} rows, expected a whole slow one", test.out_ah.len())));
    }
    test.temperature_c = sum_c / test.out_ah.len() as f64;
    Ok(test)
}

fn slow_source(
    file: &MeasuredFile,
    number: usize,
    voltage_max_v: f64,
    capacity_ah: f64,
) -> Result<AnchoredPart, LabError> {
    let mut part = clean(&file.parts[0]);
    let out_ah = part.taken_out_ah(voltage_max_v, capacity_ah);
    let out_ah = out_ah.map_err(|e| LabError::Data(format!("{}: {e}", file.path.display())))?;
    let most = out_ah.iter().enumerate().fold(0, |most, (k, ah)| if *ah > out_ah[most] { k } else { most });
    let judged = (0..out_ah.len()).map(|k| k <= most).collect();
    part.soc = out_ah.iter().map(|ah| 1.0 - ah / capacity_ah).collect();
    Ok(AnchoredPart { file: number, part, judged, scale: None })
}

fn need_cycles(files: &[MeasuredFile]) -> Result<(), LabError> {
    let without = files.iter().find(|file| file.parts.iter().any(|part| part.key.is_empty() || part.kind.is_empty()));
    without.map_or(Ok(()), |file| {
        Err(LabError::Data(format!("{}: --first-cycles needs the columns cycle and type", file.path.display())))
    })
}

fn ageing_sources(
    files: &[MeasuredFile],
    first: usize,
    voltage_v: (f64, f64),
    notes: Vec<String>,
) -> Result<FitInputs, LabError> {
    let mut prepared = FitInputs { sources: vec![], capacity_ah: 0.0, voltage_v, ocv: vec![], notes };
    for (number, file) in files.iter().enumerate() {
        let fail = |what: String| LabError::Data(format!("{}: {what}", file.path.display()));
        let mut early = Vec::new();
        for part in &file.parts {
            let cycle: usize = part.key.parse().map_err(|_| fail(format!("cycle {:?}: not a number", part.key)))?;
            if cycle <= first {
                early.push(clean(part));
            }
        }
        let (capacity_ah, anchored) = ageing::anchor(&early, voltage_v).map_err(fail)?;
        prepared.capacity_ah += capacity_ah / files.len() as f64;
        let mut early: Vec<Option<MeasuredPart>> = early.into_iter().map(Some).collect();
        for half in anchored {
            let Some(mut part) = early[half.index].take() else { continue };
            let scale = Some(if part.is_discharge() { 1.0 } else { AGEING_CHARGE_SCALE });
            (part.current_a, part.soc) = (half.current_a, half.soc);
            prepared.sources.push(AnchoredPart { file: number, part, judged: half.judged, scale });
        }
    }
    Ok(prepared)
}

impl FitInputs {
    pub(super) fn records(&self, grid: &Grid) -> (Vec<Record>, Vec<f64>) {
        let limits = Limits {
            voltage_low_v: (self.voltage_v.0 - CREDIBLE_BEYOND_V.0).max(DISCONNECTED_V),
            voltage_high_v: self.voltage_v.1 + CREDIBLE_BEYOND_V.1,
            capacity_ah: self.capacity_ah,
        };
        let record = |source: &AnchoredPart| Record::prepare(&source.part, &source.judged, grid, &limits);
        let records: Vec<Record> = self.sources.iter().map(record).collect();
        // Division by the largest share gives slow tests and pulse tests full weight if there is no drive.
        let most = records.iter().map(record::share).fold(0.0, f64::max);
        let by_share = |r: &Record| record::weight(r) * record::share(r) / most;
        let scale = self.sources.iter().zip(&records).map(|(s, r)| s.scale.unwrap_or_else(|| by_share(r)));
        let scale = scale.collect();
        (records, scale)
    }

    pub(super) fn by_kind(&self, records: &[Record], fitted: &FittedTables) -> (Residual, Residual) {
        let of_kind = |discharge: bool| {
            let own = self.sources.iter().zip(records).filter(|(s, _)| s.part.is_discharge() == discharge);
            let own: Vec<Record> = own.map(|(_, record)| record.clone()).collect();
            fit::judge(&own, &fitted.tables)
        };
        (of_kind(true), of_kind(false))
    }

    /// Returns the temperatures of the parts; similar temperatures are averaged. Cells warm up under load, so the
    /// lowest decile of a part's rows counts.
    pub(super) fn temperature_nodes(&self) -> Vec<f64> {
        let coldest = |source: &AnchoredPart| {
            let mut seen = source.part.temperature_c.clone();
            seen.sort_by(f64::total_cmp);
            seen[seen.len() / 10]
        };
        let mut all: Vec<f64> = self.sources.iter().map(coldest).collect();
        all.sort_by(f64::total_cmp);
        let mut nodes: Vec<(f64, f64)> = Vec::new();
        let mut last = f64::NEG_INFINITY;
        for t in all {
            match nodes.last_mut() {
                // Parts within 5 K share a node.
                Some((sum, count)) if t - last < 5.0 => (*sum, *count) = (*sum + t, *count + 1.0),
                _ => nodes.push((t, 1.0)),
            }
            last = t;
        }
        nodes.iter().map(|(sum, count)| (sum / count).round() + 0.0).collect()
    }
}
