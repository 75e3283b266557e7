//! Tests the conversion of small BPX texts whose curve and resistances are known in closed form.

#![allow(clippy::unwrap_used, reason = "in a test a panic is the message")]

use serde_json::{Value, json};

use super::*;
use crate::cell::CellModel;

/// Creates a cell whose electrodes have straight potential curves: `u_p = 5 - y`, `u_n = 1 - x`, so the voltage is
/// `4 + x - y`. x and y are the lithium contents of the negative and the positive electrode.
fn straight() -> Value {
    let electrode = |ocp: &str, low: f64, high: f64| {
        json!({
            "Thickness [m]": 1e-4, "Surface area per unit volume [m-1]": 3e5, "Particle radius [m]": 5e-6,
            "Maximum concentration [mol.m-3]": 30000, "Minimum stoichiometry": low, "Maximum stoichiometry": high,
            "OCP [V]": ocp, "Diffusivity [m2.s-1]": 1e-14, "Reaction rate constant [mol.m-2.s-1]": 1e-6,
            "Diffusivity activation energy [J.mol-1]": 30000, "Reaction rate constant activation energy [J.mol-1]": 40000,
        })
    };
    json!({
        "Header": {"BPX": "0.4.0", "Title": "straight", "Model": "SPM"},
        "Parameterisation": {
            "Cell": {
                "Electrode area [m2]": 0.1, "Number of electrode pairs connected in parallel to make a cell": 2,
                "Lower voltage cut-off [V]": 3.3, "Upper voltage cut-off [V]": 4.5, "Nominal cell capacity [A.h]": 5,
                "Reference temperature [K]": 298.15,
            },
            "Negative electrode": electrode("1 - x", 0.1, 0.8),
            "Positive electrode": electrode("5 - x", 0.3, 0.9),
        }
    })
}

fn full() -> Value {
    let mut value = straight();
    value["Header"]["Model"] = json!("DFN");
    let layer =
        [("Porosity", json!(0.25)), ("Transport efficiency", json!(0.125)), ("Conductivity [S.m-1]", json!(10))];
    for side in ["Negative electrode", "Positive electrode"] {
        for (key, number) in &layer {
            value["Parameterisation"][side][key] = number.clone();
        }
    }
    value["Parameterisation"]["Separator"] =
        json!({"Thickness [m]": 2e-5, "Porosity": 0.5, "Transport efficiency": 0.4});
    value["Parameterisation"]["Electrolyte"] = json!({
        "Initial concentration [mol.m-3]": 1000, "Cation transference number": 0.25, "Conductivity [S.m-1]": "x / 1000",
        "Diffusivity [m2.s-1]": 2e-10,
    });
    value
}

fn import_value(value: &Value) -> Result<BpxImport, LabError> {
    import(&value.to_string(), &BpxSettings { source: "own.json".to_owned(), name: None })
}

fn model_of(value: &Value) -> CellModel {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.toml");
    std::fs::write(&path, import_value(value).unwrap().text).unwrap();
    crate::config::cell_model::load(&path).unwrap()
}

fn electrode_ah() -> f64 {
    FARADAY_C_PER_MOL * 0.5 * 1e-4 * 0.2 * 30_000.0 / 3600.0
}

#[test]
fn straight_potentials_give_a_straight_curve() {
    // Both electrodes have the same capacity, so x + y is constant (1.1). With the voltage 4 + x - y, this gives
    // x = 0.8 at 4.5 V and x = 0.2 at 3.3 V. The minimum of x that the file states has no effect.
    let model = model_of(&straight());
    assert!((model.capacity_ah - 0.6 * electrode_ah()).abs() < 1e-4, "{}", model.capacity_ah);
    for soc in [0.0, 0.13, 0.5, 0.99, 1.0] {
        let voltage_v = model.ocv_v(&model.grid_position(soc, 25.0));
        assert!((voltage_v - (3.3 + 1.2 * soc)).abs() < 2e-6, "{soc}: {voltage_v}");
    }
}

#[test]
fn table_and_expression_give_the_same_model() {
    let mut value = straight();
    value["Parameterisation"]["Negative electrode"]["OCP [V]"] = json!({"x": [1, 0], "y": [0, 1]});
    let [a, b] = [&straight(), &value].map(model_of);
    for soc in [0.0, 0.3, 1.0] {
        let [a_v, b_v] = [&a, &b].map(|model| model.ocv_v(&model.grid_position(soc, 25.0)));
        assert!((a_v - b_v).abs() < 2e-6);
    }
}

#[test]
fn entropic_change_shifts_the_curve_with_temperature() {
    let mut value = straight();
    value["Parameterisation"]["Positive electrode"]["Entropic change coefficient [V.K-1]"] = json!(2e-4);
    value["Parameterisation"]["Negative electrode"]["Entropic change coefficient [V.K-1]"] = json!("-1e-4 * x");
    let model = model_of(&value);
    // At SOC 0.5, x = 0.5. The cell is 15 K warmer than the reference temperature.
    let voltage_v = model.ocv_v(&model.grid_position(0.5, 40.0));
    assert!((voltage_v - (3.9 + 15.0 * 2.5e-4)).abs() < 2e-6, "{voltage_v}");
}

#[test]
fn single_particle_resistances_match_the_closed_forms() {
    let model = model_of(&straight());
    // At SOC 0.5: x = 0.5, y = 0.6. The surface of each electrode is 3e5 * 1e-4 * 0.2 = 6 m2.
    let position = model.grid_position(0.5, 25.0);
    let transfer = |content: f64| {
        GAS_J_PER_MOL_K * 298.15
            / (FARADAY_C_PER_MOL * FARADAY_C_PER_MOL * 1e-6 * (content * (1.0 - content)).sqrt() * 6.0)
    };
    let expected = transfer(0.5) + transfer(0.6);
    assert!((model.r0_ohm(&position) / expected - 1.0).abs() < 1e-3, "{} {expected}", model.r0_ohm(&position));
    assert_eq!(model.branches.len(), 2);
    let diffusion = 5e-6 / (5.0 * 1e-14 * FARADAY_C_PER_MOL * 30_000.0 * 6.0);
    for branch in 0..2 {
        assert!((model.branch_r_ohm(branch, &position) / diffusion - 1.0).abs() < 1e-3);
        assert!((model.branch_tau_s(branch, &position) / (25e-12 / 35e-14) - 1.0).abs() < 1e-3);
    }
    // The table has a row 15 K below the reference temperature. R0 is larger there by the Arrhenius factor (40 kJ/mol),
    // and changes with the factor R T / F of the charge transfer.
    let colder = model.r0_ohm(&model.grid_position(0.5, 10.0)) / model.r0_ohm(&position);
    let law = (40_000.0 / GAS_J_PER_MOL_K * (1.0 / 283.15 - 1.0 / 298.15)).exp() * 283.15 / 298.15;
    assert!((colder / law - 1.0).abs() < 1e-3, "{colder} {law}");
}

#[test]
fn electrolyte_adds_conduction_and_a_branch() {
    let (particle, model) = (model_of(&straight()), model_of(&full()));
    let position = model.grid_position(0.5, 25.0);
    let conduction = (2.0 * 1e-4 / (3.0 * 0.125) + 2e-5 / 0.4 + 2.0 * 1e-4 / 30.0) / 0.2;
    let added = model.r0_ohm(&position) - particle.r0_ohm(&particle.grid_position(0.5, 25.0));
    assert!((added / conduction - 1.0).abs() < 2e-3, "{added} {conduction}");
    assert_eq!(model.branches.len(), 3);
    let path = (2.0 * 1e-4 / (3.0 * 0.125) + 2e-5 / 0.4) / 2e-10;
    let thermal_v = GAS_J_PER_MOL_K * 298.15 / FARADAY_C_PER_MOL;
    let expected = 2.0 * thermal_v * 0.75 * 0.75 * path / (FARADAY_C_PER_MOL * 0.2 * 1000.0);
    assert!((model.branch_r_ohm(0, &position) / expected - 1.0).abs() < 2e-3);
}

#[test]
fn model_states_assumptions_and_a_wide_error() {
    let result = import_value(&full()).unwrap();
    assert!(result.notes.iter().any(|note| note.contains("25 kJ/mol")), "{:?}", result.notes);
    assert!(import_value(&straight()).unwrap().notes.iter().any(|note| note.starts_with("SPM")));
    let model = model_of(&full());
    let [here, cold] = [25.0, -10.0].map(|t| model.voltage_error_v(&model.grid_position(0.5, t)).unwrap());
    assert!(here >= ERROR_AT_REST_V && cold > here);
}

#[test]
fn all_faults_are_reported_with_their_paths() {
    let mut value = full();
    let parameters = &mut value["Parameterisation"];
    parameters["Cell"]["Nominal cell capacity [A.h]"] = json!(-1);
    parameters["Negative electrode"]["OCP [V]"] = json!("1 - y");
    parameters["Positive electrode"]["Particle radius [m]"] = json!("wide");
    parameters["Positive electrode"].as_object_mut().unwrap().remove("OCP [V]");
    parameters["Separator"]["Porosity"] = json!(1.5);
    parameters["Electrolyte"]["Diffusivity [m2.s-1]"] = json!({"x": [0, 1], "y": [0]});
    let error = import_value(&value).unwrap_err().to_string();
    for line in [
        "own.json: Parameterisation.Cell.Nominal cell capacity [A.h]: -1, must be above 0, at most 100000",
        "own.json: Parameterisation.Negative electrode.OCP [V]: column 5: \"y\", must be x or one of exp",
        "own.json: Parameterisation.Positive electrode.Particle radius [m]: \"wide\", must be a number above 0",
        "own.json: Parameterisation.Positive electrode.OCP [V]: missing, must be a number, an expression or a table",
        "own.json: Parameterisation.Separator.Porosity: 1.5, must be above 0, at most 1",
        "own.json: Parameterisation.Electrolyte.Diffusivity [m2.s-1].y: 1 values, must be 2, one per x",
    ] {
        assert!(error.lines().any(|found| found.starts_with(line)), "{line}\n{error}");
    }
    assert_eq!(error.lines().count(), 6, "{error}");
}

#[test]
fn unsuitable_files_are_rejected() {
    for (path, key, found, text) in [
        ("/Header", "Model", json!("Partial"), "Header.Model: \"Partial\", must be \"SPM\""),
        ("/Header", "BPX", json!("2.0"), "Header.BPX: \"2.0\", must be a version 0.x or 1.x"),
        (
            "/Parameterisation/Cell",
            "Upper voltage cut-off [V]",
            json!(9),
            "must be reached by the open-circuit voltage",
        ),
        ("/Parameterisation/Cell", "Upper voltage cut-off [V]", json!(3), "must be above the lower, 3.3"),
        ("/Parameterisation/Negative electrode", "Particle", json!({}), "a blend of materials, must be one material"),
        ("/Parameterisation", "Cell", json!(null), "Parameterisation.Cell: missing, must be an object"),
        (
            "/Parameterisation/Negative electrode",
            "Diffusivity [m2.s-1]",
            json!("log(x - 2)"),
            "resistance of NaN ohm, must be",
        ),
    ] {
        let mut value = straight();
        value.pointer_mut(path).unwrap()[key] = found;
        let error = import_value(&value).unwrap_err().to_string();
        assert!(error.contains(text), "{text}\n{error}");
    }
    let mut value = full();
    value["Parameterisation"]["Electrolyte"]["Diffusivity [m2.s-1]"] = json!(2e-50);
    let error = import_value(&value).unwrap_err().to_string();
    assert!(error.contains("at SOC 0 and") && error.contains("ohm, must be 1e-9 to 1000 ohm"), "{error}");
    assert!(import_value(&json!([])).unwrap_err().to_string().contains("must be BPX"));
    assert!(import("{", &BpxSettings::default()).unwrap_err().to_string().contains("not valid JSON"));
}

#[test]
fn numeric_version_and_state_section_are_read() {
    let mut value = full();
    value["Header"]["BPX"] = json!(1.1);
    value["Parameterisation"]["Electrolyte"].as_object_mut().unwrap().remove("Initial concentration [mol.m-3]");
    value["State"] = json!({
        "Initial conditions": {"Initial electrolyte concentration [mol.m-3]": 2000},
        "Thermal environment": {"Heat transfer coefficient [W.m-2.K-1]": 10},
        "Degradation": {"LLI": 0.1},
    });
    for (key, number) in [
        ("Density [kg.m-3]", 2000.0),
        ("Specific heat capacity [J.K-1.kg-1]", 1000.0),
        ("Volume [m3]", 5e-5),
        ("External surface area [m2]", 0.01),
    ] {
        value["Parameterisation"]["Cell"][key] = json!(number);
    }
    let [usual, richer] = [&full(), &value].map(model_of);
    let r0_ohm = |model: &CellModel| model.r0_ohm(&model.grid_position(0.5, 25.0));
    assert!(r0_ohm(&richer) < r0_ohm(&usual));
    let thermal = richer.thermal.unwrap();
    assert!((thermal.heat_capacity_j_per_k - 100.0).abs() < 1e-6 && (thermal.resistance_k_per_w - 10.0).abs() < 1e-3);
    assert!(import_value(&value).unwrap().notes.iter().any(|note| note.contains("Degradation")));
}
