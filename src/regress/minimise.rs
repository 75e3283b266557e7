//! Minimises a smooth function of a few variables within bounds, by a quasi-Newton method (BFGS).
//!
//! If the descent would move a variable beyond its bound, the variable stays fixed during the step. Each step is
//! projected onto the bounds and shortened until the function decreases enough (Armijo condition). A point at which the
//! function has no value counts as infinitely high.

/// Value and gradient of the objective; `None` = no value at this point.
pub(super) type Evaluation = Option<(f64, Vec<f64>)>;

#[derive(Debug, Clone, PartialEq)]
pub(super) struct Minimum {
    pub x: Vec<f64>,
    pub value: f64,
    pub gradient: Vec<f64>,
    pub iterations: usize,
}

#[derive(Debug, Clone)]
pub(super) struct SearchLimits<'a> {
    pub low: &'a [f64],
    pub high: &'a [f64],
    pub max_iterations: usize,
    /// The search ends after two successive steps that each lower the value by less than this.
    pub tolerance: f64,
}

/// Minimises from `start`. An error of the objective ends the search and is returned. `Ok(None)` = the objective has no
/// value at the start.
pub(super) fn minimise<E>(
    start: &[f64],
    limits: &SearchLimits,
    mut objective: impl FnMut(&[f64]) -> Result<Evaluation, E>,
    mut report: impl FnMut(&Minimum) -> Result<(), E>,
) -> Result<Option<Minimum>, E> {
    let x: Vec<f64> =
        (start.iter().zip(limits.low.iter().zip(limits.high))).map(|(x, (l, h))| x.clamp(*l, *h)).collect();
    let Some((value, gradient)) = objective(&x)?.filter(is_finite) else { return Ok(None) };
    let mut at = Minimum { x, value, gradient, iterations: 0 };
    let mut inverse = InverseHessian::new(at.x.len());
    let mut small_falls = 0;
    report(&at)?;
    while at.iterations < limits.max_iterations {
        let direction = inverse.direction(&at, limits);
        let Some(next) = line_search(&at, &direction, limits, &mut objective)? else {
            if inverse.fresh {
                break;
            }
            inverse = InverseHessian::new(at.x.len());
            continue;
        };
        small_falls = if at.value - next.value < limits.tolerance { small_falls + 1 } else { 0 };
        inverse.update(&at, &next);
        at = next;
        report(&at)?;
        if small_falls == 2 {
            break;
        }
    }
    Ok(Some(at))
}

fn is_finite((value, gradient): &(f64, Vec<f64>)) -> bool {
    value.is_finite() && gradient.iter().all(|slope| slope.is_finite())
}

fn line_search<E>(
    at: &Minimum,
    direction: &[f64],
    limits: &SearchLimits,
    objective: &mut impl FnMut(&[f64]) -> Result<Evaluation, E>,
) -> Result<Option<Minimum>, E> {
    let longest = direction.iter().fold(0.0_f64, |m, d| m.max(d.abs()));
    if longest == 0.0 {
        return Ok(None);
    }
    // A step changes no variable by more than 2. Variables are logarithms, so this is a factor of about 7.
    let mut step = (2.0 / longest).min(1.0);
    for _ in 0..12 {
        let x: Vec<f64> =
            (0..at.x.len()).map(|k| (at.x[k] + step * direction[k]).clamp(limits.low[k], limits.high[k])).collect();
        let slope: f64 = (0..x.len()).map(|k| at.gradient[k] * (x[k] - at.x[k])).sum();
        let found = objective(&x)?;
        if let Some((value, gradient)) = found.filter(is_finite) {
            // The value must decrease by at least this fraction of the decrease that the gradient predicts.
            if slope < 0.0 && value <= at.value + 1e-4 * slope {
                return Ok(Some(Minimum { x, value, gradient, iterations: at.iterations + 1 }));
            }
            // A parabola has the value and slope of the current point, and the value of this trial. The next trial is
            // its minimum, limited to 10 % to 50 % of the present step.
            let bend = 2.0 * (value - at.value - slope);
            step *= if bend > 0.0 { (-slope / bend).clamp(0.1, 0.5) } else { 0.5 };
        } else {
            step *= 0.25;
        }
    }
    Ok(None)
}

struct InverseHessian {
    matrix: Vec<f64>,
    size: usize,
    fresh: bool,
}

impl InverseHessian {
    fn new(size: usize) -> Self {
        let mut matrix = vec![0.0; size * size];
        (0..size).for_each(|k| matrix[k * size + k] = 1.0);
        Self { matrix, size, fresh: true }
    }

    fn times(&self, v: &[f64]) -> Vec<f64> {
        (0..self.size).map(|i| (0..self.size).map(|j| self.matrix[i * self.size + j] * v[j]).sum()).collect()
    }

    fn direction(&self, at: &Minimum, limits: &SearchLimits) -> Vec<f64> {
        let held = |k: usize| {
            (at.x[k] <= limits.low[k] && at.gradient[k] > 0.0) || (at.x[k] >= limits.high[k] && at.gradient[k] < 0.0)
        };
        let free: Vec<f64> = (0..self.size).map(|k| if held(k) { 0.0 } else { at.gradient[k] }).collect();
        let mut direction: Vec<f64> = self.times(&free).iter().map(|d| -d).collect();
        (0..self.size).filter(|k| held(*k)).for_each(|k| direction[k] = 0.0);
        let descends = direction.iter().zip(&free).map(|(d, g)| d * g).sum::<f64>() < 0.0;
        if descends { direction } else { free.iter().map(|g| -g).collect() }
    }

    fn update(&mut self, old: &Minimum, new: &Minimum) {
        let n = self.size;
        let s: Vec<f64> = (0..n).map(|k| new.x[k] - old.x[k]).collect();
        let y: Vec<f64> = (0..n).map(|k| new.gradient[k] - old.gradient[k]).collect();
        let sy: f64 = s.iter().zip(&y).map(|(a, b)| a * b).sum();
        let yy: f64 = y.iter().map(|v| v * v).sum();
        if sy <= 1e-10 * yy.sqrt() * s.iter().map(|v| v * v).sum::<f64>().sqrt() {
            return;
        }
        if self.fresh {
            self.matrix.iter_mut().for_each(|m| *m *= sy / yy);
            self.fresh = false;
        }
        let hy = self.times(&y);
        let yhy: f64 = y.iter().zip(&hy).map(|(a, b)| a * b).sum();
        for i in 0..n {
            for j in 0..n {
                self.matrix[i * n + j] += (1.0 + yhy / sy) * s[i] * s[j] / sy - (hy[i] * s[j] + s[i] * hy[j]) / sy;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rosenbrock(x: &[f64]) -> Result<Evaluation, ()> {
        let (a, b) = (1.0 - x[0], x[1] - x[0] * x[0]);
        Ok(Some((a * a + 100.0 * b * b, vec![-2.0 * a - 400.0 * x[0] * b, 200.0 * b])))
    }

    fn minimum(start: &[f64], low: &[f64], high: &[f64]) -> Minimum {
        let limits = SearchLimits { low, high, max_iterations: 200, tolerance: 1e-14 };
        minimise(start, &limits, rosenbrock, |_| Ok(())).expect("no error").expect("a value")
    }

    #[test]
    fn search_follows_valley_to_minimum() {
        let found = minimum(&[-1.2, 1.0], &[-5.0, -5.0], &[5.0, 5.0]);
        assert!((found.x[0] - 1.0).abs() < 1e-5 && (found.x[1] - 1.0).abs() < 1e-5, "{found:?}");
    }

    #[test]
    fn search_stays_within_bounds() {
        let found = minimum(&[-1.2, 1.0], &[-5.0, -5.0], &[0.5, 5.0]);
        assert!(found.x[0] == 0.5 && (found.x[1] - 0.25).abs() < 1e-6, "{found:?}");
    }

    #[test]
    fn missing_value_shortens_step() {
        let limits = SearchLimits { low: &[-5.0], high: &[50.0], max_iterations: 100, tolerance: 1e-14 };
        let objective = |x: &[f64]| -> Result<Evaluation, ()> {
            Ok((x[0] < 3.0).then(|| ((x[0] - 2.9).powi(2), vec![2.0 * (x[0] - 2.9)])))
        };
        let found = minimise(&[-4.0], &limits, objective, |_| Ok(())).expect("no error").expect("a value");
        assert!((found.x[0] - 2.9).abs() < 1e-6, "{found:?}");
        assert_eq!(minimise(&[4.0], &limits, objective, |_| Ok(())), Ok(None));
    }
}
