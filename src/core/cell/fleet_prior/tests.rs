//! Tests which properties a fleet prior takes from the label, and which from the models that vehicles have learned.

use super::*;
use crate::cell::Chemistry;
use crate::cell::model_bands::CURVE_C;

fn label() -> Label {
    Label::usual(Chemistry::Nmc811Graphite, 5.0)
}

/// The model of a vehicle that has not learned anything.
fn untaught() -> OwnModel {
    let prior = label().prior().unwrap();
    let (modes_v, rest_v) = prior.curve.modes_v();
    let array = |values: &[f64]| std::array::from_fn(|s| values[s]);
    OwnModel {
        curve_v: array(&prior.curve.mean_v),
        modes_v: modes_v.each_ref().map(|mode_v| array(mode_v)),
        rest_v: array(&rest_v),
        factors: ResistanceFactors::default(),
        drop_std: [0.45; TEMPERATURE_NODES],
        cold_sag_v: usual_cold_sag_v(),
        capacity: ScalarGaussian::from_std(5.0, 0.5),
        residual_v: 0.0,
    }
}

/// Models of vehicles whose cells are well known. The mean cell of all vehicles differs from the label. The curves,
/// resistances and capacities of the vehicles differ from the mean cell with the given standard deviations (V, ln, Ah).
fn taught(count: u32, [curve_v, log_resistance, capacity_ah]: [f64; 3]) -> Vec<OwnModel> {
    let untaught = untaught();
    let vehicle = |k: u32| {
        // Each property orders the vehicles differently. Its values are evenly spread with a variance of 1.
        let place = |step: u32| (f64::from(k * step % count) + 0.5) / f64::from(count) - 0.5;
        let [a, b, c] = [1, 3, 7].map(|step| 12_f64.sqrt() * place(step));
        let mut own = untaught.clone();
        own.curve_v.iter_mut().for_each(|v| *v += 0.02 + curve_v * a);
        own.modes_v = [[0.0; SOC_NODES]; 2];
        own.rest_v = [0.004; SOC_NODES];
        own.factors.ln.iter_mut().flatten().for_each(|ln| *ln = 0.5 + log_resistance * b);
        own.drop_std = [0.05; TEMPERATURE_NODES];
        own.capacity = ScalarGaussian::from_std(4.5 + capacity_ah * c, 0.05);
        own
    };
    (0..count).map(vehicle).collect()
}

#[test]
fn vehicles_replace_label_values_and_spread() {
    let prior = FleetPrior::new(&label(), &taught(200, [0.01, 0.15, 0.1])).unwrap();
    prior.check().unwrap();
    let [mean_v, label_v] = [prior.mean.curve_v[10], untaught().curve_v[10]];
    assert!((mean_v - label_v - 0.02).abs() < 1e-9, "{mean_v} {label_v}");
    let capacity = prior.mean.capacity;
    assert!((capacity.mean - 4.5).abs() < 0.01 && (0.1..0.12).contains(&capacity.std()), "{capacity:?}");
    let curve_std_v = prior.curve_covariance_v2[10][10].sqrt();
    assert!((0.01..0.012).contains(&curve_std_v), "{curve_std_v}");
    assert!((0.15..0.17).contains(&prior.spread.log_resistance), "{:?}", prior.spread);
    let (model, of_label) = (prior.cell_model().unwrap(), label().model().unwrap());
    let ohm = |model: &CellModel| model.settled_ohm(&model.grid_position(0.5, CURVE_C));
    assert!((ohm(&model) / ohm(&of_label) - 0.5_f64.exp()).abs() < 0.02);
    assert_eq!((model.capacity_ah, model.rated_capacity_ah), (capacity.mean, 5.0));
}

#[test]
fn vehicles_without_data_keep_label_spread() {
    let prior = FleetPrior::new(&label(), &vec![untaught(); 50]).unwrap();
    let of_label = label().prior().unwrap();
    let ratio = |s: usize| (prior.curve_covariance_v2[s][s] / of_label.curve.covariance[(s, s)]).sqrt();
    for s in 1..SOC_NODES {
        assert!((0.6..1.5).contains(&ratio(s)), "{s}: {}", ratio(s));
    }
    let spread = of_label.model.spread.unwrap();
    assert!((prior.spread.log_resistance - spread.log_resistance).abs() < 1e-9);
    assert!((prior.mean.capacity.std() - 0.5).abs() < 1e-9);
    assert_eq!((prior.spread.slow_branch, prior.spread.drop_sqrt_s), (spread.slow_branch, spread.drop_sqrt_s));
}

#[test]
fn no_vehicle_gives_no_prior() {
    assert_eq!(FleetPrior::new(&label(), &[]), None);
}

#[test]
fn few_vehicles_leave_part_of_label_spread() {
    let std_ah = |count: u32| {
        let prior = FleetPrior::new(&label(), &taught(count, [0.0; 3])).unwrap();
        prior.mean.capacity.std()
    };
    let stds_ah = [3, 10, 100].map(std_ah);
    assert!(stds_ah.is_sorted_by(|a, b| a > b) && stds_ah[0] > 0.25 && stds_ah[2] < 0.08, "{stds_ah:?}");
}

#[test]
fn damaged_priors_are_refused() {
    let prior = FleetPrior::new(&label(), &taught(10, [0.01, 0.1, 0.1])).unwrap();
    let mut few = prior.clone();
    few.curve_covariance_v2.pop();
    let mut asymmetric = prior.clone();
    asymmetric.curve_covariance_v2[3][4] = 1.0;
    let mut negative = prior.clone();
    negative.spread.capacity = -0.1;
    let mut falling = prior.clone();
    falling.mean.curve_v[5] = 9.0;
    let mut exact = prior.clone();
    exact.spread.log_resistance = 0.0;
    let mut large = prior.clone();
    large.mean.capacity.mean = 900.0;
    let mut high = prior.clone();
    high.mean.curve_v.iter_mut().for_each(|v| *v += 10.0);
    let mut indefinite = prior;
    (indefinite.curve_covariance_v2[3][4], indefinite.curve_covariance_v2[4][3]) = (1.0, 1.0);
    for damaged in [few, asymmetric, negative, falling, exact, large, high, indefinite] {
        assert!(damaged.check().is_err(), "{damaged:?}");
    }
}
