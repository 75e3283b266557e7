//! Levenberg-Marquardt: finds the minimum of a cost with damped steps.
//!
//! The damping falls after a step that lowers the cost, and grows after any other step. The caller computes the step
//! for a given damping.

/// Damping, relative to the diagonal of the normal matrix.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Damping {
    pub first: f64,
    /// Factor after a step that lowers the cost.
    pub fall: f64,
    /// Factor after a step that lowers the cost, if the previous step did not.
    pub fall_after_growth: f64,
    /// Factor after a step that does not lower the cost.
    pub growth: f64,
    pub least: f64,
    /// The search ends when the damping exceeds this value.
    pub most: f64,
}

/// Outcome of [`minimise`].
#[derive(Debug, Clone, PartialEq)]
pub struct Minimum<T> {
    /// The point with the lowest cost.
    pub best: T,
    /// Number of steps, including steps that did not lower the cost.
    pub steps: usize,
    /// Whether the search has converged: by the caller's criterion, or because the damping exceeded its maximum.
    pub has_converged: bool,
}

/// Tries at most `steps` damped steps from `start`.
///
/// `step(point, damping)` returns the next point, or `None` if its cost is not lower.
/// `has_converged(from, to, damping)` is called after every step that lowers the cost.
pub fn minimise<T>(
    damping: &Damping,
    steps: usize,
    start: T,
    mut step: impl FnMut(&T, f64) -> Option<T>,
    mut has_converged: impl FnMut(&T, &T, f64) -> bool,
) -> Minimum<T> {
    let mut found = Minimum { best: start, steps: 0, has_converged: false };
    let (mut present, mut fall) = (damping.first, damping.fall);
    while found.steps < steps && !found.has_converged {
        found.steps += 1;
        if let Some(better) = step(&found.best, present) {
            found.has_converged = has_converged(&found.best, &better, present);
            found.best = better;
            (present, fall) = ((present * fall).max(damping.least), damping.fall);
        } else {
            (present, fall) = (present * damping.growth, damping.fall_after_growth);
            found.has_converged = present > damping.most;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    const DAMPING: Damping =
        Damping { first: 1e-3, fall: 0.2, fall_after_growth: 0.2, growth: 8.0, least: 1e-9, most: 1e6 };

    /// Rosenbrock's valley, with the residuals 10 (y - x^2) and 1 - x.
    fn cost([x, y]: [f64; 2]) -> f64 {
        50.0 * (y - x * x) * (y - x * x) + 0.5 * (1.0 - x) * (1.0 - x)
    }

    fn step(&[x, y]: &[f64; 2], damping: f64) -> Option<[f64; 2]> {
        let residuals = [10.0 * (y - x * x), 1.0 - x];
        let (a, b, d) = (400.0 * x * x + 1.0, -200.0 * x, 100.0);
        let gradient = [-20.0 * x * residuals[0] - residuals[1], 10.0 * residuals[0]];
        let (a, d) = (a * (1.0 + damping), d * (1.0 + damping));
        let determinant = a * d - b * b;
        let next = [
            x - (d * gradient[0] - b * gradient[1]) / determinant,
            y - (a * gradient[1] - b * gradient[0]) / determinant,
        ];
        Some(next).filter(|next| cost(*next) < cost([x, y]))
    }

    #[test]
    fn curved_valley_is_followed_to_its_end() {
        let found = minimise(&DAMPING, 100, [-1.2, 1.0], step, |from, to, _| cost(*from) - cost(*to) < 1e-20);
        assert!(found.has_converged && found.steps < 50, "{found:?}");
        assert!(found.best.iter().all(|x| (x - 1.0).abs() < 1e-8), "{found:?}");
    }

    #[test]
    fn useless_steps_end_at_most_damping() {
        let found = minimise(&DAMPING, 100, 1.0, |_, _| None, |_, _, _| false);
        assert_eq!(found, Minimum { best: 1.0, steps: 10, has_converged: true });
    }
}
