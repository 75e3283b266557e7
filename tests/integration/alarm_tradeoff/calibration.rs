//! Compares the Monitor's stated uncertainty with the truth: stated probabilities with observed frequencies, and stated
//! standard deviations with capacity errors.

use super::Fleet;
use super::life::{Evaluation, Life, RATED_AH, THRESHOLD};

/// Bin edges of the stated probability.
pub(crate) const EDGES: [f64; 9] = [0.0, 0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0];
/// Number of half-cycles (charges or discharges) that are skipped at the start of a life, because the initial capacity
/// still affects the estimate.
const SETTLING: usize = 10;

/// Probability that the true capacity is below the threshold, with the alarm rule's formula.
pub(crate) fn stated(evaluation: &Evaluation) -> f64 {
    0.5 * libm::erfc((evaluation.mean_ah - THRESHOLD * RATED_AH) / (evaluation.std_ah * std::f64::consts::SQRT_2))
}

fn is_beyond(evaluation: &Evaluation) -> bool {
    evaluation.true_ah < THRESHOLD * RATED_AH
}

fn evaluations(lives: &[Life]) -> impl Iterator<Item = &Evaluation> {
    lives.iter().flat_map(|life| life.evaluations.iter().skip(SETTLING)).filter(|evaluation| evaluation.is_measured)
}

/// For each bin of the stated probability: number of evaluations, mean stated probability, and share of the evaluations
/// at which the true capacity is below the threshold.
pub(crate) fn bins(fleet: &Fleet) -> Vec<(usize, f64, f64)> {
    let bin = |edges: &[f64]| {
        let inside = |p: f64| p >= edges[0] && (p < edges[1] || edges[1] == 1.0);
        let all: Vec<&Evaluation> =
            evaluations(&fleet.ageing).chain(evaluations(&fleet.healthy)).filter(|l| inside(stated(l))).collect();
        let n = all.len() as f64;
        let stated_mean = all.iter().map(|evaluation| stated(evaluation)).sum::<f64>() / n;
        let true_share = all.iter().filter(|evaluation| is_beyond(evaluation)).count() as f64 / n;
        (all.len(), stated_mean, true_share)
    };
    EDGES.windows(2).map(bin).collect()
}

/// Capacity errors of the ageing cells. Only measured half-cycles after the first `SETTLING` count.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Errors {
    /// Mean error. It is in percent of the rated capacity, like the next three values.
    pub(crate) mean: f64,
    /// Standard deviation of the lives' mean errors.
    pub(crate) between_lives: f64,
    /// Standard deviation of the error within a life.
    pub(crate) within_life: f64,
    /// Mean of the stated standard deviations.
    pub(crate) stated: f64,
    /// Fractions of evaluations within the stated 68 % and 95 % intervals.
    pub(crate) inside_68: f64,
    pub(crate) inside_95: f64,
}

fn mean(values: impl Iterator<Item = f64> + Clone) -> f64 {
    values.clone().sum::<f64>() / values.count() as f64
}

pub(crate) fn errors(fleet: &Fleet) -> Errors {
    let percent = |evaluation: &Evaluation| 100.0 * (evaluation.mean_ah - evaluation.true_ah) / RATED_AH;
    let sigmas = |evaluation: &Evaluation| (evaluation.mean_ah - evaluation.true_ah).abs() / evaluation.std_ah;
    let of_life = |life: &Life| {
        let errors: Vec<f64> = evaluations(std::slice::from_ref(life)).map(percent).collect();
        let middle = mean(errors.iter().copied());
        (middle, mean(errors.iter().map(|error| (error - middle) * (error - middle))))
    };
    let lives: Vec<(f64, f64)> = fleet.ageing.iter().map(of_life).collect();
    let middle = mean(lives.iter().map(|life| life.0));
    let share = |limit: f64| {
        mean(
            evaluations(&fleet.ageing)
                .map(|evaluation| f64::from(u8::from(sigmas(evaluation) <= limit)))
                .collect::<Vec<_>>()
                .into_iter(),
        )
    };
    Errors {
        mean: middle,
        between_lives: mean(lives.iter().map(|life| (life.0 - middle) * (life.0 - middle))).sqrt(),
        within_life: mean(lives.iter().map(|life| life.1)).sqrt(),
        stated: mean(
            evaluations(&fleet.ageing)
                .map(|evaluation| 100.0 * evaluation.std_ah / RATED_AH)
                .collect::<Vec<_>>()
                .into_iter(),
        ),
        inside_68: share(1.0),
        inside_95: share(1.96),
    }
}
