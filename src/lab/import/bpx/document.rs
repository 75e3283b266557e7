//! Reads the parameters for a cell model from the JSON of a BPX file.
//!
//! Input: the JSON, versions 0.x and 1.x, models SPM, SPMe and DFN. Output: [`BpxCell`], in the file's SI units.
//! Reading continues after a fault, so that all faults are reported.

use serde_json::{Map, Value};

use super::function::{Function, found};

/// Reference temperature if the file does not state it (K).
const USUAL_TEMPERATURE_K: f64 = 298.15;

#[derive(Debug, Clone)]
pub(super) struct BpxCell {
    pub(super) title: Option<String>,
    pub(super) references: Option<String>,
    pub(super) version: String,
    /// SPM, SPMe or DFN.
    pub(super) model: String,
    pub(super) nominal_ah: f64,
    pub(super) voltage_min_v: f64,
    pub(super) voltage_max_v: f64,
    pub(super) reference_k: f64,
    /// Sum of the areas of all electrode pairs (m2).
    pub(super) area_m2: f64,
    pub(super) negative: Electrode,
    pub(super) positive: Electrode,
    /// Transport in the electrolyte; `None` for the model SPM.
    pub(super) transport: Option<Transport>,
    /// Heat capacity (J/K); `None` = density, volume or specific heat capacity is missing.
    pub(super) heat_capacity_j_per_k: Option<f64>,
    /// Thermal resistance to the surroundings (K/W); `None` = heat transfer coefficient or surface is missing.
    pub(super) thermal_k_per_w: Option<f64>,
    pub(super) notes: Vec<String>,
}

#[derive(Debug, Clone)]
pub(super) struct Electrode {
    pub(super) thickness_m: f64,
    pub(super) surface_per_m: f64,
    pub(super) radius_m: f64,
    /// Largest concentration of lithium in the active material (mol/m3).
    pub(super) concentration_max: f64,
    pub(super) stoichiometry: [f64; 2],
    pub(super) ocp_v: Function,
    /// Change of the potential with temperature (V/K); 0 if not stated.
    pub(super) entropic: Function,
    /// Diffusivity of lithium in the particles (m2/s).
    pub(super) diffusivity: Function,
    pub(super) diffusivity_j_per_mol: Option<f64>,
    /// Rate constant of the charge transfer (mol/(m2 s)).
    pub(super) reaction_rate: f64,
    pub(super) reaction_j_per_mol: Option<f64>,
}

#[derive(Debug, Clone)]
pub(super) struct Transport {
    pub(super) layers: [Layer; 3],
    /// Conductivity of the solid of the negative and positive electrode (S/m).
    pub(super) solid_s_per_m: [f64; 2],
    pub(super) concentration: f64,
    pub(super) transference: f64,
    /// Conductivity of the electrolyte at this concentration (S/m).
    pub(super) conductivity: f64,
    pub(super) conductivity_j_per_mol: Option<f64>,
    /// Diffusivity of the electrolyte at this concentration (m2/s).
    pub(super) diffusivity: f64,
    pub(super) diffusivity_j_per_mol: Option<f64>,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Layer {
    pub(super) thickness_m: f64,
    pub(super) porosity: f64,
    pub(super) transport_efficiency: f64,
}

/// Range of a number: above the first value, at most the second.
type Above = (f64, f64);

const POSITIVE: Above = (0.0, f64::MAX);
const SHARE: Above = (0.0, 1.0);

/// Reads the JSON.
///
/// # Errors
/// The JSON has faults.
pub(super) fn read(root: &Value) -> Result<BpxCell, Vec<String>> {
    let mut faults = Vec::new();
    let cell = Section::root(root).cell(&mut faults);
    match cell {
        Some(cell) if faults.is_empty() => Ok(cell),
        _ => Err(faults),
    }
}

/// An object of the JSON with its path. The keys of a missing object are not reported as missing.
struct Section<'a> {
    path: String,
    keys: Option<&'a Map<String, Value>>,
}

impl<'a> Section<'a> {
    fn root(root: &'a Value) -> Self {
        Self { path: String::new(), keys: root.as_object() }
    }

    fn place(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) }
    }

    fn get(&self, key: &str) -> Option<&'a Value> {
        self.keys?.get(key).filter(|value| !value.is_null())
    }

    /// Returns a member that is an object and may be missing.
    fn optional(&self, key: &str) -> Self {
        Self { path: self.place(key), keys: self.get(key).and_then(Value::as_object) }
    }

    /// Returns a member that is an object, or adds a fault if it is missing.
    fn below(&self, key: &str, faults: &mut Vec<String>) -> Self {
        let below = self.optional(key);
        if self.keys.is_some() && below.keys.is_none() {
            let found = self.get(key).map_or_else(|| "missing".to_owned(), found);
            faults.push(format!("{}: {found}, must be an object", below.path));
        }
        below
    }

    fn text(&self, key: &str) -> Option<String> {
        Some(self.get(key)?.as_str()?.trim().to_owned()).filter(|text| !text.is_empty())
    }

    fn optional_number(&self, key: &str, (above, most): Above, faults: &mut Vec<String>) -> Option<f64> {
        let value = self.get(key)?;
        let number = value.as_f64().filter(|number| (*number > above) && *number <= most);
        if number.is_none() {
            let allowed = match (above < 0.0, most == f64::MAX) {
                (true, _) => format!("0 to {most}"),
                (false, true) => format!("a number above {above}"),
                (false, false) => format!("above {above}, at most {most}"),
            };
            faults.push(format!("{}: {}, must be {allowed}", self.place(key), found(value)));
        }
        number
    }

    /// Reads a number. If it is missing or invalid, adds a fault and returns NaN.
    fn number(&self, key: &str, range: Above, faults: &mut Vec<String>) -> f64 {
        self.require(key, "a number", faults);
        self.optional_number(key, range, faults).unwrap_or(f64::NAN)
    }

    fn require(&self, key: &str, allowed: &str, faults: &mut Vec<String>) {
        if self.keys.is_some() && self.get(key).is_none() {
            faults.push(format!("{}: missing, must be {allowed}", self.place(key)));
        }
    }

    /// Reads an activation energy (J/mol); `None` = not stated, or stated as 0.
    fn energy(&self, key: &str, faults: &mut Vec<String>) -> Option<f64> {
        // This range includes 0.
        self.optional_number(key, (-f64::MIN_POSITIVE, 1e6), faults).filter(|energy| *energy > 0.0)
    }

    fn optional_function(&self, key: &str, faults: &mut Vec<String>) -> Option<Function> {
        let read = Function::read(self.get(key)?);
        let note = |(below, text): (String, String)| faults.push(format!("{}{below}: {text}", self.place(key)));
        read.map_err(|found| found.into_iter().for_each(note)).ok()
    }

    fn function(&self, key: &str, faults: &mut Vec<String>) -> Function {
        self.require(key, "a number, an expression or a table", faults);
        self.optional_function(key, faults).unwrap_or(Function::Constant(f64::NAN))
    }

    /// Reads the cell; `None` = the file is not BPX, or its version or model is not supported.
    fn cell(&self, faults: &mut Vec<String>) -> Option<BpxCell> {
        if self.keys.is_none() {
            faults.push("the file does not contain a JSON object, must be BPX".to_owned());
            return None;
        }
        let header = self.below("Header", faults);
        let (version, model) = header.kind(faults)?;
        let parameters = self.below("Parameterisation", faults);
        let keys = parameters.below("Cell", faults);
        let state = self.optional("State");
        let mut notes = Vec::new();
        state.note_degradation(&mut notes);
        let [negative, positive] = ["Negative electrode", "Positive electrode"]
            .map(|key| parameters.below(key, faults).electrode(&mut notes, faults));
        let transport = (model != "SPM").then(|| parameters.transport(&state, faults));
        let pairs = keys.number("Number of electrode pairs connected in parallel to make a cell", POSITIVE, faults);
        let cell = BpxCell {
            title: header.text("Title"),
            references: header.text("References").or_else(|| header.text("Description")),
            version,
            model,
            nominal_ah: keys.number("Nominal cell capacity [A.h]", (0.0, 1e5), faults),
            voltage_min_v: keys.number("Lower voltage cut-off [V]", (0.0, 100.0), faults),
            voltage_max_v: keys.number("Upper voltage cut-off [V]", (0.0, 100.0), faults),
            reference_k: keys.reference_k(&mut notes, faults),
            area_m2: pairs * keys.number("Electrode area [m2]", POSITIVE, faults),
            negative,
            positive,
            transport,
            heat_capacity_j_per_k: keys.heat_capacity(faults),
            thermal_k_per_w: thermal_k_per_w(&keys, &state.optional("Thermal environment"), faults),
            notes,
        };
        if cell.voltage_max_v <= cell.voltage_min_v {
            let (place, min) = (keys.place("Upper voltage cut-off [V]"), cell.voltage_min_v);
            faults.push(format!("{place}: {}, must be above the lower, {min}", cell.voltage_max_v));
        }
        Some(cell)
    }

    fn kind(&self, faults: &mut Vec<String>) -> Option<(String, String)> {
        self.keys?;
        let version = match self.get("BPX") {
            Some(Value::String(text)) => text.clone(),
            Some(Value::Number(number)) => number.to_string(),
            _ => String::new(),
        };
        let is_known = matches!(version.split('.').next(), Some("0" | "1"));
        if !is_known {
            let found = if version.is_empty() { "missing".to_owned() } else { format!("{version:?}") };
            faults.push(format!("{}: {found}, must be a version 0.x or 1.x", self.place("BPX")));
        }
        let model = self.text("Model").unwrap_or_default();
        let is_read = matches!(model.as_str(), "SPM" | "SPMe" | "DFN");
        if !is_read {
            let found = self.get("Model").map_or_else(|| "missing".to_owned(), found);
            faults.push(format!("{}: {found}, must be \"SPM\", \"SPMe\" or \"DFN\"", self.place("Model")));
        }
        (is_known && is_read).then_some((version, model))
    }

    fn note_degradation(&self, notes: &mut Vec<String>) {
        if self.get("Degradation").is_some() {
            notes.push(format!("{}: not used; the model is of the new cell", self.place("Degradation")));
        }
    }

    fn reference_k(&self, notes: &mut Vec<String>, faults: &mut Vec<String>) -> f64 {
        let key = "Reference temperature [K]";
        if self.get(key).is_none() {
            notes.push(format!("{}: missing; {USUAL_TEMPERATURE_K} assumed", self.place(key)));
            return USUAL_TEMPERATURE_K;
        }
        self.optional_number(key, (200.0, 400.0), faults).unwrap_or(f64::NAN)
    }

    fn electrode(&self, notes: &mut Vec<String>, faults: &mut Vec<String>) -> Electrode {
        if self.get("Particle").is_some() {
            faults.push(format!("{}: a blend of materials, must be one material", self.place("Particle")));
            return Section { path: String::new(), keys: None }.electrode(notes, faults);
        }
        for key in ["OCP (delithiation) [V]", "OCP (lithiation) [V]"] {
            if self.get(key).is_some() {
                notes.push(format!("{}: hysteresis is not modelled; OCP [V] used", self.place(key)));
            }
        }
        let stoichiometry = ["Minimum stoichiometry", "Maximum stoichiometry"];
        let [low, high] = stoichiometry.map(|key| self.number(key, (-f64::MIN_POSITIVE, 1.0), faults));
        if high <= low {
            faults.push(format!("{}: {high}, must be above the minimum, {low}", self.place(stoichiometry[1])));
        }
        let entropic = self.optional_function("Entropic change coefficient [V.K-1]", faults);
        Electrode {
            thickness_m: self.number("Thickness [m]", POSITIVE, faults),
            surface_per_m: self.number("Surface area per unit volume [m-1]", POSITIVE, faults),
            radius_m: self.number("Particle radius [m]", POSITIVE, faults),
            concentration_max: self.number("Maximum concentration [mol.m-3]", POSITIVE, faults),
            stoichiometry: [low, high],
            ocp_v: self.function("OCP [V]", faults),
            entropic: entropic.unwrap_or(Function::Constant(0.0)),
            diffusivity: self.function("Diffusivity [m2.s-1]", faults),
            diffusivity_j_per_mol: self.energy("Diffusivity activation energy [J.mol-1]", faults),
            reaction_rate: self.number("Reaction rate constant [mol.m-2.s-1]", POSITIVE, faults),
            reaction_j_per_mol: self.energy("Reaction rate constant activation energy [J.mol-1]", faults),
        }
    }

    fn transport(&self, state: &Section<'_>, faults: &mut Vec<String>) -> Transport {
        let electrolyte = self.below("Electrolyte", faults);
        let separator = self.below("Separator", faults);
        let [negative, positive] = ["Negative electrode", "Positive electrode"].map(|key| self.optional(key));
        let initial = state.optional("Initial conditions");
        let concentration = electrolyte
            .optional_number("Initial concentration [mol.m-3]", POSITIVE, faults)
            .or_else(|| initial.optional_number("Initial electrolyte concentration [mol.m-3]", POSITIVE, faults))
            // 1 mol per litre is the value of PyBaMM.
            .unwrap_or(1000.0);
        let [conductivity, diffusivity] = ["Conductivity [S.m-1]", "Diffusivity [m2.s-1]"]
            .map(|key| electrolyte.value_at(key, concentration, faults));
        Transport {
            // A wrong thickness of an electrode was already reported when the electrode was read.
            layers: [&negative, &separator, &positive].map(|layer| layer.layer(faults)),
            solid_s_per_m: [&negative, &positive].map(|solid| solid.number("Conductivity [S.m-1]", POSITIVE, faults)),
            concentration,
            transference: electrolyte.number("Cation transference number", (-f64::MIN_POSITIVE, 1.0), faults),
            conductivity,
            conductivity_j_per_mol: electrolyte.energy("Conductivity activation energy [J.mol-1]", faults),
            diffusivity,
            diffusivity_j_per_mol: electrolyte.energy("Diffusivity activation energy [J.mol-1]", faults),
        }
    }

    fn layer(&self, faults: &mut Vec<String>) -> Layer {
        let mut seen = Vec::new();
        let thickness_m = self.number("Thickness [m]", POSITIVE, &mut seen);
        if self.path.ends_with("Separator") {
            faults.append(&mut seen);
        }
        Layer {
            thickness_m,
            porosity: self.number("Porosity", SHARE, faults),
            transport_efficiency: self.number("Transport efficiency", SHARE, faults),
        }
    }

    /// Returns the positive value of a function at `x`.
    fn value_at(&self, key: &str, x: f64, faults: &mut Vec<String>) -> f64 {
        let before = faults.len();
        let value = self.function(key, faults).at(x);
        let is_positive = value > 0.0 && value.is_finite();
        if self.keys.is_some() && faults.len() == before && !is_positive {
            faults.push(format!("{}: {value} at x = {x}, must be above 0", self.place(key)));
        }
        value
    }

    fn heat_capacity(&self, faults: &mut Vec<String>) -> Option<f64> {
        let keys = ["Specific heat capacity [J.K-1.kg-1]", "Density [kg.m-3]", "Volume [m3]"];
        let [heat, density, volume] = keys.map(|key| self.optional_number(key, POSITIVE, faults));
        Some(heat? * density? * volume?)
    }
}

fn thermal_k_per_w(cell: &Section<'_>, thermal: &Section<'_>, faults: &mut Vec<String>) -> Option<f64> {
    let coefficient =
        thermal.optional_number("Heat transfer coefficient [W.m-2.K-1]", (-f64::MIN_POSITIVE, 1e9), faults);
    let surface = cell.optional_number("External surface area [m2]", POSITIVE, faults);
    Some(1.0 / (coefficient.filter(|value| *value > 0.0)? * surface?))
}
