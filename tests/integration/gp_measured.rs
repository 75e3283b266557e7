//! Repeats the Gaussian process regression of "Battery Predictions for Electronic Prognostics" on the paper's data: the
//! voltage of cell RW9 as a function of time, temperature and current. The kernel is exponential, the basis constant,
//! and the inputs are standardised. This test holds out only one of five folds. The paper reports an RMSE of 0.1058 V
//! over all five folds.

use std::ops::ControlFlow;
use std::path::Path;

use crate::support::measured;
use packwatch::regress::{Form, GprSettings, Model, TrainingRows, assign, fit, score};

/// Inputs (time, temperature, current) row by row, and voltages.
fn rows(file: &Path) -> (Vec<f64>, Vec<f64>) {
    let mut table = csv::Reader::from_reader(flate2::read::GzDecoder::new(std::fs::File::open(file).unwrap()));
    let header = table.headers().unwrap().clone();
    let column = |name: &str| header.iter().position(|column| column == name).unwrap();
    let columns = ["time_s", "temperature_c", "current_a", "voltage_v"].map(column);
    let (mut inputs, mut targets) = (Vec::new(), Vec::new());
    for record in table.records() {
        let record = record.unwrap();
        let number = |k: usize| record[columns[k]].parse::<f64>().unwrap();
        inputs.extend([number(0), number(1), number(2)]);
        targets.push(number(3));
    }
    (inputs, targets)
}

#[test]
#[cfg_attr(not(measured_data), ignore = "no measured data (PACKWATCH_DATA)")]
fn exponential_kernel_beats_paper_with_valid_intervals() {
    let file = measured::path("nasa_randomized/RW9_random_walk_sampled_0p4pct.csv.gz");
    let (inputs, targets) = rows(&file);
    assert_eq!(targets.len(), 30_723);
    let fold = assign(targets.len(), 5, 1);
    let part = |held: bool| -> (Vec<f64>, Vec<f64>) {
        let some: Vec<usize> = (0..targets.len()).filter(|row| (fold[*row] == 0) == held).collect();
        (
            some.iter().flat_map(|row| inputs[3 * row..][..3].to_vec()).collect(),
            some.iter().map(|r| targets[*r]).collect(),
        )
    };
    let ((inputs, targets), (queries, truth)) = (part(false), part(true));
    let settings = GprSettings::new("exponential".parse().unwrap(), targets.len());
    assert_eq!(settings.form, Form::Nearest { neighbours: 40 });
    let rows = TrainingRows { inputs: &inputs, dimensions: 3, targets: &targets, lines: &[] };
    let model = fit(&rows, &settings, &mut |_| ControlFlow::Continue(())).unwrap();
    let predictions = model.predict(&queries).unwrap();
    let score = score(&predictions, &truth);
    println!("{score:?}, {} steps", model.outcome.iterations);
    assert!(score.rmse <= 0.1058, "{score:?}");
    assert!((0.93..=0.97).contains(&score.coverage_95), "{score:?}");
    assert_eq!(model.outcome.jitter.matrices, 0);
    let loaded = Model::load(&model.save().unwrap(), 2).unwrap();
    assert_eq!(loaded.predict(&queries[..300]).unwrap(), predictions[..100]);
}
