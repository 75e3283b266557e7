//! Estimates the capacity by published least-squares methods. Their input is a list of swings. A swing is a change x of
//! the SOC (fraction), with the charge y (Ah) that caused it. If Q is the capacity (Ah), y = Q x. sx and sy are the
//! standard deviations of x and y.
//!
//! G. L. Plett, "Recursive approximate weighted total least squares estimation of battery cell total capacity", J.
//! Power Sources 196 (2011) 2319. Every method gives older swings less weight (fading memory):
//!
//! - WLS (weighted least squares): only y has errors
//! - TLS (total least squares): x and y have errors, with the same ratio sx/sy for all swings
//! - AWTLS (approximate weighted TLS): x and y have errors, with any sx and sy for each swing
//!
//! The running sums, with the weight w = gamma^(n-i) for swing i of n, are:
//!
//! - c1 = sum w x^2/sy^2, c2 = sum w xy/sy^2, c3 = sum w y^2/sy^2
//! - c4 = sum w x^2/sx^2, c5 = sum w xy/sx^2, c6 = sum w y^2/sx^2
//!
//! AWTLS minimises the cost sum w (Q^2/sx^2 + 1/sy^2) (y - Q x)^2 / (Q^2 + 1)^2. Because this approximation holds for Q
//! near 1, y and sy are first scaled by K = sx/sy. The minimum is at a root of a quartic in Q. The variance is 2
//! divided by the cost's second derivative at the minimum.

use packwatch::filter::ScalarGaussian;

/// A measured swing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Swing {
    /// Change of SOC (fraction).
    pub(crate) x: f64,
    pub(crate) x_variance: f64,
    /// Charge (Ah).
    pub(crate) y_ah: f64,
    pub(crate) y_variance: f64,
}

/// Estimation method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Method {
    Wls,
    Tls,
    Awtls,
}

/// A recursive capacity estimate, to compare with the estimate of packwatch.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Peer {
    pub(crate) method: Method,
    /// Fading memory factor; 1 = no fading.
    pub(crate) gamma: f64,
    c: [f64; 6],
    x_information: f64,
    y_information: f64,
}

impl Peer {
    /// Starts from a prior capacity as Plett does: with one full swing (x = 1) whose charge is the prior capacity. The
    /// prior's variance is split between x and y.
    pub(crate) fn new(method: Method, gamma: f64, start: ScalarGaussian) -> Self {
        let mut peer = Self { method, gamma, c: [0.0; 6], x_information: 0.0, y_information: 0.0 };
        let y_variance = 0.5 * start.variance;
        let x_variance = y_variance / (start.mean * start.mean);
        peer.take(&Swing { x: 1.0, x_variance, y_ah: start.mean, y_variance });
        peer
    }

    pub(crate) fn take(&mut self, swing: &Swing) {
        let Swing { x, x_variance, y_ah: y, y_variance } = *swing;
        // WLS has errors in y only, so convert the errors in x with the present capacity estimate.
        let y_variance = match self.method {
            Method::Wls => {
                let q = if self.c[0] > 0.0 { self.c[1] / self.c[0] } else { y / x };
                y_variance + q * q * x_variance
            }
            Method::Tls | Method::Awtls => y_variance,
        };
        let products = [x * x, x * y, y * y];
        for (k, product) in products.into_iter().enumerate() {
            self.c[k] = self.gamma * self.c[k] + product / y_variance;
            self.c[3 + k] = self.gamma * self.c[3 + k] + product / x_variance;
        }
        self.x_information = self.gamma * self.x_information + 1.0 / x_variance;
        self.y_information = self.gamma * self.y_information + 1.0 / y_variance;
    }

    pub(crate) fn capacity(&self) -> ScalarGaussian {
        let [c1, c2, c3, ..] = self.c;
        match self.method {
            Method::Wls => ScalarGaussian { mean: c2 / c1, variance: 1.0 / c1 },
            Method::Tls => tls([c1, c2, c3], self.scale()),
            Method::Awtls => {
                let k = self.scale();
                let scaled = awtls(&self.scaled(k));
                ScalarGaussian { mean: scaled.mean / k, variance: scaled.variance / (k * k) }
            }
        }
    }

    /// K = sx/sy, averaged over all swings.
    fn scale(&self) -> f64 {
        (self.y_information / self.x_information).sqrt()
    }

    /// The running sums for y scaled by `k`.
    fn scaled(&self, k: f64) -> [f64; 6] {
        let [c1, c2, c3, c4, c5, c6] = self.c;
        [c1 / (k * k), c2 / k, c3, c4, k * c5, k * k * c6]
    }
}

/// TLS: minimum of (c3 - 2 c2 Q + c1 Q^2) / (1 + k^2 Q^2), for errors in x and y with the fixed ratio k = sx/sy.
fn tls([c1, c2, c3]: [f64; 3], k: f64) -> ScalarGaussian {
    let k2 = k * k;
    let half = c1 - k2 * c3;
    let q = (-half + (half * half + 4.0 * k2 * c2 * c2).sqrt()) / (2.0 * k2 * c2);
    // The cost's slope is 2 N / (1 + k2 Q^2)^2 with N = k2 c2 Q^2 + half Q - c2. At the minimum N = 0, so the second
    // derivative is 2 N' / (1 + k2 Q^2)^2.
    let spread = 1.0 + k2 * q * q;
    let curvature = 2.0 * (2.0 * k2 * c2 * q + half) / (spread * spread);
    ScalarGaussian { mean: q, variance: 2.0 / curvature }
}

/// The cost of AWTLS: (c4 Q^4 - 2 c5 Q^3 + (c1 + c6) Q^2 - 2 c2 Q + c3) / (Q^2 + 1)^2.
fn awtls_cost([c1, c2, c3, c4, c5, c6]: &[f64; 6], q: f64) -> f64 {
    ((((c4 * q - 2.0 * c5) * q + (c1 + c6)) * q - 2.0 * c2) * q + c3) / (q * q + 1.0).powi(2)
}

/// Minimum of [`awtls_cost`] among its stationary points. The cost's derivative is 2 P(Q) / (Q^2 + 1)^3 with
/// `P = c5 Q^4 + (2 c4 - c1 - c6) Q^3 + 3 (c2 - c5) Q^2 + (c1 - 2 c3 + c6) Q - c2`. At a root of P the second
/// derivative is 2 P' / (Q^2 + 1)^3.
fn awtls(c: &[f64; 6]) -> ScalarGaussian {
    let [c1, c2, c3, c4, c5, c6] = *c;
    let p = [c5, 2.0 * c4 - c1 - c6, 3.0 * (c2 - c5), c1 - 2.0 * c3 + c6, -c2];
    let value = |q: f64| p.iter().fold(0.0, |sum, a| sum * q + a);
    let slope = |q: f64| ((4.0 * p[0] * q + 3.0 * p[1]) * q + 2.0 * p[2]) * q + p[3];
    let q = positive_roots(value, slope)
        .into_iter()
        .min_by(|a, b| awtls_cost(c, *a).total_cmp(&awtls_cost(c, *b)))
        .expect("c2 and c5 are positive: P rises from -c2 to infinity and crosses zero");
    ScalarGaussian { mean: q, variance: (q * q + 1.0).powi(3) / slope(q) }
}

/// Upward zero crossings of a polynomial in Q between 0 and infinity. Sets Q = tan(angle) and searches in equal steps
/// of the angle.
fn positive_roots(value: impl Fn(f64) -> f64, slope: impl Fn(f64) -> f64) -> Vec<f64> {
    const STEPS: u32 = 2000;
    let at = |k: u32| (f64::from(k) / f64::from(STEPS) * std::f64::consts::FRAC_PI_2).tan();
    let mut roots = Vec::new();
    for k in 0..STEPS {
        let (mut low, mut high) = (at(k), at(k + 1));
        if value(low) >= 0.0 || value(high) < 0.0 {
            continue;
        }
        let mut q = 0.5 * (low + high);
        for _ in 0..100 {
            if value(q) < 0.0 {
                low = q;
            } else {
                high = q;
            }
            let newton = q - value(q) / slope(q);
            let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
            if next == q {
                break;
            }
            q = next;
        }
        roots.push(q);
    }
    roots
}

mod tests {
    use super::*;

    /// Uniform numbers in [0, 1) by splitmix64. The sum of twelve numbers, minus six, is approximately normal.
    struct Random(u64);

    impl Random {
        fn uniform(&mut self) -> f64 {
            self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
            let mut z = self.0;
            z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
            ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
        }

        fn normal(&mut self) -> f64 {
            (0..12).fold(-6.0, |sum, _| sum + self.uniform())
        }
    }

    /// Draws swings of a 10 Ah cell with random errors in x and y.
    fn swings(random: &mut Random, count: usize, even: bool) -> Vec<Swing> {
        let one = |random: &mut Random| {
            let wide = if even { 1.0 } else { 0.5 + random.uniform() };
            let (x, x_std, y_std) = (0.2 + 0.6 * random.uniform(), 0.01 * wide, if even { 0.1 } else { 0.08 });
            let (x_error, y_error) = (x_std * random.normal(), y_std * random.normal());
            let (x_variance, y_variance) = (x_std * x_std, y_std * y_std);
            Swing { x: x + x_error, x_variance, y_ah: 10.0 * x + y_error, y_variance }
        };
        (0..count).map(|_| one(random)).collect()
    }

    fn run(method: Method, gamma: f64, start: ScalarGaussian, swings: &[Swing]) -> Peer {
        let mut peer = Peer::new(method, gamma, start);
        swings.iter().for_each(|swing| peer.take(swing));
        peer
    }

    /// Minimum of `f` over [low, high]: searches a grid, then three ever finer grids around the best point.
    fn brute_force(f: impl Fn(f64) -> f64, mut low: f64, mut high: f64) -> f64 {
        let mut best = low;
        for _ in 0..4 {
            let step = (high - low) / 2000.0;
            let points = (0..=2000).map(|k| low + f64::from(k) * step);
            best = points.min_by(|a, b| f(*a).total_cmp(&f(*b))).expect("a grid has points");
            (low, high) = (best - step, best + step);
        }
        best
    }

    #[test]
    fn awtls_matches_brute_force_minimum() {
        for (seed, gamma) in [(1, 1.0), (2, 0.95), (3, 0.8)] {
            let (start, list) = (ScalarGaussian::from_std(8.0, 1.0), swings(&mut Random(seed), 40, false));
            let peer = run(Method::Awtls, gamma, start, &list);
            let k = peer.scale();
            let first = Swing { x: 1.0, x_variance: 0.5 / 64.0, y_ah: 8.0, y_variance: 0.5 };
            let all: Vec<Swing> = std::iter::once(first).chain(list).collect();
            let cost = |capacity_ah: f64| {
                let q = k * capacity_ah;
                all.iter().rev().enumerate().fold(0.0, |sum, (age, s)| {
                    let off = (k * s.y_ah - q * s.x) / (1.0 + q * q);
                    let weight = q * q / s.x_variance + 1.0 / (k * k * s.y_variance);
                    sum + gamma.powi(age as i32) * off * off * weight
                })
            };
            let (found, least) = (peer.capacity(), brute_force(cost, 0.1, 40.0));
            assert!((found.mean - least).abs() < 1e-6, "seed {seed}: {} against {least}", found.mean);
            let h = 1e-3;
            let curvature = (cost(least + h) - 2.0 * cost(least) + cost(least - h)) / (h * h);
            assert!((found.variance * curvature / 2.0 - 1.0).abs() < 1e-3, "seed {seed}: {found:?}, {curvature}");
        }
    }

    #[test]
    fn awtls_equals_tls_for_constant_ratio() {
        let list = swings(&mut Random(7), 30, true);
        // A prior of 10 Ah has the same ratio sx/sy as the swings.
        let [a, b] =
            [Method::Awtls, Method::Tls].map(|m| run(m, 0.9, ScalarGaussian::from_std(10.0, 1.0), &list).capacity());
        assert!((a.mean - b.mean).abs() < 1e-9 && (a.variance / b.variance - 1.0).abs() < 1e-9, "{a:?} {b:?}");
    }

    #[test]
    fn total_least_squares_is_unbiased_with_valid_intervals() {
        let mut random = Random(11);
        let mut mean = [0.0; 3];
        let mut covered = [0.0; 3];
        for _ in 0..200 {
            let list = swings(&mut random, 100, true);
            for (i, method) in [Method::Wls, Method::Tls, Method::Awtls].into_iter().enumerate() {
                let found = run(method, 1.0, ScalarGaussian::from_std(8.0, 5.0), &list).capacity();
                mean[i] += found.mean / 200.0;
                covered[i] += f64::from(u8::from((found.mean - 10.0).abs() < 1.96 * found.std())) / 200.0;
            }
        }
        println!("mean of 200 runs (true 10 Ah): WLS, TLS, AWTLS {mean:.4?}, covered {covered:.3?}");
        assert!((mean[1] - 10.0).abs() < 0.005 && (mean[2] - 10.0).abs() < 0.005, "{mean:?}");
        assert!(covered[1] > 0.9 && covered[2] > 0.9, "{covered:?}");
        // Noise in x reduces the slope of WLS by sx^2 / mean(x^2), here about 3.5 parts in 10^4.
        assert!(mean[0] < mean[2], "{mean:?}");
    }
}
