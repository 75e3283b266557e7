//! Seeded random numbers for a life: uniform, normal, log-normal.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A stream of random numbers.
pub(crate) struct Dice(ChaCha8Rng);

impl Dice {
    /// Creates random stream number `stream` for the seed.
    pub(crate) fn new(seed: u64, stream: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(stream);
        Self(generator)
    }

    /// Uniform from `low` to `high`.
    pub(crate) fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Normal with mean 0.
    pub(crate) fn normal(&mut self, std: f64) -> f64 {
        let radius = (-2.0 * libm::log(1.0 - self.uniform(0.0, 1.0))).sqrt();
        std * radius * libm::cos(std::f64::consts::TAU * self.uniform(0.0, 1.0))
    }

    /// A factor whose logarithm is normal with mean 0.
    pub(crate) fn factor(&mut self, std: f64) -> f64 {
        libm::exp(self.normal(std))
    }
}
