//! Computes the resistances and branches of a BPX cell. For small currents, the cell's equations have these closed
//! solutions:
//!
//! | part | resistance | time constant | source |
//! | --- | --- | --- | --- |
//! | charge transfer, each electrode | `R T / (F j0 S)`, `j0 = F k sqrt(x (1 - x))` | none: part of R0 | Butler-Volmer with equal coefficients |
//! | electrolyte | `(L_n / 3 k_n + L_s / k_s + L_p / 3 k_p) / A` | none: part of R0 | SPMe, Marquis et al., J. Electrochem. Soc. 166 (2019) A3693, eq. 40 |
//! | solid | `(L_n / s_n + L_p / s_p) / 3 A` | none: part of R0 | Marquis et al., eq. 40 |
//! | concentration of the electrolyte | `2 R T (1 - t)^2 / (F^2 A c) (L_n / 3 D_n + L_s / D_s + L_p / 3 D_p)` | `sum(L / D) sum(e L) / pi^2` | Marquis et al., eq. 40; slowest mode of a layer without exchange at its ends |
//! | diffusion in a particle, each electrode | `abs(dU/dx) r / (5 D F c_max S)` | `r^2 / 35 D` | sphere under constant flux; first moment of its step response |
//!
//! `S` is the surface of all particles of an electrode, `A` the area of all electrode pairs. `L` is the thickness of a
//! layer: negative electrode (n), separator (s) or positive electrode (p). `x` is the lithium content of a particle and
//! `r` its radius. `s_n` and `s_p` are the conductivities of the electrodes. `c` is the concentration of the
//! electrolyte, `t` its transference number, and `e` the porosity of a layer. In the row of charge transfer, `k` is the
//! rate constant. In the rows of the electrolyte, `k` and `D` of a layer are the conductivity and the diffusivity of
//! the electrolyte, multiplied by the layer's transport efficiency. Each property follows Arrhenius' law with its
//! stated activation energy or with [`USUAL_J_PER_MOL`]. Charge transfer has no time constant because BPX has no double
//! layer, which matters only for about 0.1 s.

use super::curve::Curve;
use super::document::{BpxCell, Electrode, Layer, Transport};
use super::{FARADAY_C_PER_MOL, GAS_J_PER_MOL_K};
use crate::cell::model::ACTIVATION_ENERGY_J_PER_MOL as USUAL_J_PER_MOL;
use crate::quantity::bounds::{Bounds, CAPACITANCE_F, RESISTANCE_OHM};

/// Half of the range of lithium content over which the slope of a potential is computed. It is wide enough that the
/// noise of a table does not count as slope.
const SLOPE_STEP: f64 = 0.005;

/// Smallest resistance (ohm) and time constant (s). A flat potential gives 0, but a model needs positive values.
const LEAST: f64 = 1e-7;

#[derive(Debug, Clone)]
pub(super) struct Resistances {
    pub(super) r0_ohm: f64,
    pub(super) branches: Vec<(f64, f64)>,
}

impl Resistances {
    pub(super) fn settled_ohm(&self) -> f64 {
        self.r0_ohm + self.branches.iter().map(|branch| branch.0).sum::<f64>()
    }

    /// Returns the first implausible value with its allowed range; `None` = all values are plausible.
    pub(super) fn fault(&self) -> Option<String> {
        let resistances = std::iter::once(self.r0_ohm).chain(self.branches.iter().map(|branch| branch.0));
        let capacitances = self.branches.iter().map(|(r_ohm, tau_s)| tau_s / r_ohm);
        let fault = |what: &str, unit: &str, allowed: &Bounds, found: f64| {
            (!allowed.has(found))
                .then(|| format!("the parameters give a {what} of {found:.3e} {unit}, must be {}", allowed.allowed))
        };
        let resistance = |found| fault("resistance", "ohm", &RESISTANCE_OHM, found);
        let capacitance = |found| fault("capacitance", "F", &CAPACITANCE_F, found);
        resistances.filter_map(resistance).chain(capacitances.filter_map(capacitance)).next()
    }
}

/// Returns the resistances at a SOC and a temperature (K). The branch of the electrolyte, if the file describes it,
/// comes before the branches of the electrodes.
pub(super) fn resistances(cell: &BpxCell, curve: &Curve<'_>, soc: f64, temperature_k: f64) -> Resistances {
    let (x, y) = curve.contents(soc);
    let at = |energy: Option<f64>| arrhenius(energy, cell.reference_k, temperature_k);
    let sides = [(&cell.negative, x), (&cell.positive, y)];
    let transfer = sides.map(|(electrode, content)| {
        let rate = electrode.reaction_rate * at(electrode.reaction_j_per_mol);
        charge_transfer_ohm(electrode, cell.area_m2, content, rate, temperature_k)
    });
    let particles = sides.map(|(electrode, content)| {
        let diffusivity = electrode.diffusivity.at(content) * at(electrode.diffusivity_j_per_mol);
        particle(electrode, cell.area_m2, content, diffusivity)
    });
    let mut r0_ohm = transfer[0] + transfer[1];
    let mut branches = Vec::new();
    if let Some(transport) = &cell.transport {
        let conductivity = transport.conductivity * at(transport.conductivity_j_per_mol);
        let diffusivity = transport.diffusivity * at(transport.diffusivity_j_per_mol);
        r0_ohm += conduction_ohm(transport, cell.area_m2, conductivity);
        branches.push(concentration(transport, cell.area_m2, diffusivity, temperature_k));
    }
    branches.extend(particles);
    let branches = branches.into_iter().map(|(r_ohm, tau_s)| (at_least(r_ohm), at_least(tau_s)));
    Resistances { r0_ohm: at_least(r0_ohm), branches: branches.collect() }
}

/// Returns the value, but at least [`LEAST`]. A negative value or NaN becomes NaN.
fn at_least(value: f64) -> f64 {
    if value >= 0.0 { value.max(LEAST) } else { f64::NAN }
}

/// Returns a property at a temperature, relative to its value at the reference temperature.
fn arrhenius(j_per_mol: Option<f64>, reference_k: f64, temperature_k: f64) -> f64 {
    let energy = j_per_mol.unwrap_or(USUAL_J_PER_MOL);
    libm::exp(energy / GAS_J_PER_MOL_K * (1.0 / reference_k - 1.0 / temperature_k))
}

fn surface_m2(electrode: &Electrode, area_m2: f64) -> f64 {
    electrode.surface_per_m * electrode.thickness_m * area_m2
}

fn charge_transfer_ohm(electrode: &Electrode, area_m2: f64, content: f64, rate: f64, temperature_k: f64) -> f64 {
    let exchange_a_per_m2 = FARADAY_C_PER_MOL * rate * (content * (1.0 - content)).max(1e-3).sqrt();
    GAS_J_PER_MOL_K * temperature_k / (FARADAY_C_PER_MOL * exchange_a_per_m2 * surface_m2(electrode, area_m2))
}

fn particle(electrode: &Electrode, area_m2: f64, content: f64, diffusivity: f64) -> (f64, f64) {
    let radius_m = electrode.radius_m;
    let content = content.clamp(SLOPE_STEP, 1.0 - SLOPE_STEP);
    let slope_v = electrode.ocp_v.slope(content, SLOPE_STEP).abs();
    let mol_per_s = 5.0 * diffusivity * electrode.concentration_max * surface_m2(electrode, area_m2) / radius_m;
    (slope_v / (FARADAY_C_PER_MOL * mol_per_s), radius_m * radius_m / (35.0 * diffusivity))
}

/// Sums thickness / (property x transport efficiency) over the layers. An electrode counts one third.
fn path(layers: &[Layer; 3], property: f64) -> f64 {
    let of = |layer: &Layer| layer.thickness_m / (property * layer.transport_efficiency);
    of(&layers[0]) / 3.0 + of(&layers[1]) + of(&layers[2]) / 3.0
}

fn conduction_ohm(transport: &Transport, area_m2: f64, conductivity: f64) -> f64 {
    let [negative, _, positive] = &transport.layers;
    let [s_n, s_p] = transport.solid_s_per_m;
    let solid = (negative.thickness_m / s_n + positive.thickness_m / s_p) / 3.0;
    (path(&transport.layers, conductivity) + solid) / area_m2
}

fn concentration(transport: &Transport, area_m2: f64, diffusivity: f64, temperature_k: f64) -> (f64, f64) {
    let layers = &transport.layers;
    let thermal_v = GAS_J_PER_MOL_K * temperature_k / FARADAY_C_PER_MOL;
    let anions = 1.0 - transport.transference;
    let charge = FARADAY_C_PER_MOL * area_m2 * transport.concentration;
    let r_ohm = 2.0 * thermal_v * anions * anions * path(layers, diffusivity) / charge;
    let length: f64 = layers.iter().map(|layer| layer.thickness_m / (diffusivity * layer.transport_efficiency)).sum();
    let store: f64 = layers.iter().map(|layer| layer.thickness_m * layer.porosity).sum();
    (r_ohm, length * store / std::f64::consts::PI.powi(2))
}
