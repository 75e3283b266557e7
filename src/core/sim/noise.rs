//! Generates seeded random numbers that are bit-identical on every machine.
//!
//! The generator is ChaCha with 8 rounds. Each use has its own stream, so that more cells or another scenario do not
//! change the numbers of other streams. Normal numbers come from Box-Muller with `ln`, `sin` and `cos` of `libm`.

use rand::Rng;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// Use of a stream of random numbers. A stream's number must never change or be reused, because results depend on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stream {
    Spread,
    Course,
    Current,
    PackVoltage,
    Temperature(u16),
    CellVoltage(u16),
}

impl Stream {
    fn number(self) -> u64 {
        match self {
            Self::Spread => 0,
            Self::Course => 1,
            Self::Current => 2,
            Self::PackVoltage => 3,
            Self::Temperature(i) => 0x1_0000 + u64::from(i),
            Self::CellVoltage(i) => 0x2_0000 + u64::from(i),
        }
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Noise {
    generator: ChaCha8Rng,
    spare_normal: Option<f64>,
}

impl Noise {
    pub(crate) fn new(seed: u64, stream: Stream) -> Self {
        Self::of_number(seed, stream.number())
    }

    /// The stream for the constant errors of a sensor whose noise uses `stream`.
    pub(crate) fn of_channel(seed: u64, stream: Stream) -> Self {
        // Noise streams have numbers below 0x10_0000.
        Self::of_number(seed, 0x10_0000 + stream.number())
    }

    fn of_number(seed: u64, number: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(number);
        Self { generator, spare_normal: None }
    }

    /// A number uniformly distributed in [0, 1).
    pub(crate) fn uniform(&mut self) -> f64 {
        const UNIT: f64 = 1.0 / (1_u64 << 53) as f64;
        (self.generator.next_u64() >> 11) as f64 * UNIT
    }

    /// A number uniformly distributed in [`low`, `high`).
    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    pub(crate) fn choose<T: Copy, const N: usize>(&mut self, choices: &[T; N]) -> T {
        const { assert!(N > 0) };
        choices[((self.uniform() * N as f64) as usize).min(N - 1)]
    }

    /// A normally distributed number with mean 0 and standard deviation 1.
    pub(crate) fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare_normal.take() {
            return spare;
        }
        let radius = (-2.0 * libm::log(1.0 - self.uniform())).sqrt(); // 1 - u is never 0
        let angle = std::f64::consts::TAU * self.uniform();
        self.spare_normal = Some(radius * libm::sin(angle));
        radius * libm::cos(angle)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn same_seed_and_stream_repeat_numbers() {
        let mut noise = Noise::new(1, Stream::Current);
        let first = [noise.normal(), noise.normal(), noise.uniform()];
        let mut again = Noise::new(1, Stream::Current);
        assert_eq!(first, [again.normal(), again.normal(), again.uniform()]);
        assert_ne!(first[0], Noise::new(1, Stream::PackVoltage).normal());
        assert_ne!(first[0], Noise::new(2, Stream::Current).normal());
    }

    #[test]
    fn normal_numbers_have_gaussian_mean_deviation_and_tails() {
        let mut noise = Noise::new(7, Stream::CellVoltage(3));
        let n = 200_000;
        let values: Vec<f64> = (0..n).map(|_| noise.normal()).collect();
        let mean = values.iter().sum::<f64>() / f64::from(n);
        let variance = values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / f64::from(n);
        let beyond_2 = values.iter().filter(|v| v.abs() > 2.0).count() as f64 / f64::from(n);
        assert!(mean.abs() < 0.01, "mean {mean}");
        assert!((variance - 1.0).abs() < 0.015, "variance {variance}");
        assert!((beyond_2 - 0.0455).abs() < 0.002, "share beyond 2 {beyond_2}");
    }

    #[test]
    fn uniform_fills_its_range_evenly() {
        let mut noise = Noise::new(3, Stream::Course);
        let mut counts = [0_u32; 10];
        for _ in 0..100_000 {
            counts[(noise.between(2.0, 4.0) * 5.0) as usize - 10] += 1;
        }
        assert!(counts.iter().all(|&c| (9_500..10_500).contains(&c)), "{counts:?}");
    }
}
