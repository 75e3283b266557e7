//! Simulates sensors: turns true values into readings with errors.
//!
//! `reading = round_to_resolution(truth (1 + gain) + offset + noise_std n)`. n is normally distributed and independent
//! from sample to sample. Resolution 0 leaves quantisation to the signal's encoding in the DBC.

use super::noise::{Noise, Stream};

/// Errors of one kind of sensor, in the unit of the sensor.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct SensorError {
    /// Standard deviation of the white noise per sample.
    pub noise_std: f64,
    /// Constant error of all channels.
    pub offset: f64,
    /// Relative gain error.
    pub gain: f64,
    /// Resolution of the converter; 0 = unlimited.
    pub resolution: f64,
    /// Probability that a sample is missing.
    pub dropout: f64,
    /// Standard deviation of an additional constant error per channel, drawn from the seed.
    pub offset_std: f64,
    /// Standard deviation of an additional gain error per channel, drawn from the seed.
    pub gain_std: f64,
}

impl SensorError {
    /// A sensor without errors.
    pub const NONE: Self =
        Self { noise_std: 0.0, offset: 0.0, gain: 0.0, resolution: 0.0, dropout: 0.0, offset_std: 0.0, gain_std: 0.0 };
}

/// Errors per channel are clipped at this many standard deviations.
const CHANNEL_LIMIT: f64 = 2.0;

/// Errors of all sensors of a pack.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Sensors {
    /// Pack current (A).
    pub current: SensorError,
    /// Cell voltages (V). The pack voltage has no offset. Its noise is the noise of a cell voltage times the square
    /// root of the number of cells.
    pub voltage: SensorError,
    /// Temperatures (degrees C).
    pub temperature: SensorError,
}

/// Quality of all sensors of a pack.
///
/// | quality | voltage offset | voltage step | current gain + offset | current step | temperature offset |
/// | --- | --- | --- | --- | --- | --- |
/// | `Good` | 1 mV | 0.1 mV | 0.1 % + 5 mA | 1 mA | 0.3 K |
/// | `Usual` | 5 mV | 1 mV | 0.5 % + 50 mA | 10 mA | 1 K |
/// | `Poor` | 15 mV | 5 mV | 2 % + 300 mA | 60 mA | 3 K |
///
/// Offsets and gains are standard deviations across channels. They are clipped at two standard deviations and constant
/// in time. For voltage and current, the standard deviation of the noise equals one step. Temperatures have steps of
/// 0.1 K and noise of 0.02 K.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SensorQuality {
    /// Laboratory equipment, or the best vehicles.
    Good,
    /// Typical vehicles.
    Usual,
    /// Cheap or old sensors.
    Poor,
}

impl Sensors {
    /// Sensors of the given quality.
    pub fn of_quality(quality: SensorQuality) -> Self {
        let (voltage, current, temperature_c) = match quality {
            SensorQuality::Good => ((0.001, 0.0001), (0.001, 0.005, 0.001), 0.3),
            SensorQuality::Usual => ((0.005, 0.001), (0.005, 0.05, 0.01), 1.0),
            SensorQuality::Poor => ((0.015, 0.005), (0.02, 0.3, 0.06), 3.0),
        };
        let (offset_v, step_v) = voltage;
        let (gain, offset_a, step_a) = current;
        let none = SensorError::NONE;
        Self {
            current: SensorError {
                noise_std: step_a,
                resolution: step_a,
                offset_std: offset_a,
                gain_std: gain,
                ..none
            },
            voltage: SensorError { noise_std: step_v, resolution: step_v, offset_std: offset_v, ..none },
            temperature: SensorError { noise_std: 0.02, resolution: 0.1, offset_std: temperature_c, ..none },
        }
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Sensor {
    error: SensorError,
    noise: Noise,
}

impl Sensor {
    pub(crate) fn new(mut error: SensorError, seed: u64, stream: Stream) -> Self {
        let mut channel = Noise::of_channel(seed, stream);
        let mut draw = |std: f64| std * channel.normal().clamp(-CHANNEL_LIMIT, CHANNEL_LIMIT);
        error.offset += draw(error.offset_std);
        error.gain += draw(error.gain_std);
        Self { error, noise: Noise::new(seed, stream) }
    }

    pub(crate) fn offset(&self) -> f64 {
        self.error.offset
    }

    /// Measures `truth`; `None` = the sample is missing.
    pub(crate) fn read(&mut self, truth: f64) -> Option<f64> {
        let e = self.error;
        let value = truth * (1.0 + e.gain) + e.offset + e.noise_std * self.noise.normal();
        let dropped = e.dropout > 0.0 && self.noise.uniform() < e.dropout;
        if dropped {
            return None;
        }
        Some(if e.resolution > 0.0 { (value / e.resolution).round() * e.resolution } else { value })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn readings(error: SensorError, truth: f64, n: usize) -> Vec<Option<f64>> {
        let mut sensor = Sensor::new(error, 11, Stream::Current);
        (0..n).map(|_| sensor.read(truth)).collect()
    }

    #[test]
    fn ideal_sensor_reads_true_value() {
        assert_eq!(readings(SensorError::default(), 3.7, 3), vec![Some(3.7); 3]);
    }

    #[test]
    fn noise_offset_and_gain_match_settings() {
        let error = SensorError { noise_std: 0.02, offset: 0.01, gain: 0.005, ..SensorError::default() };
        let values: Vec<f64> = readings(error, 2.0, 100_000).into_iter().flatten().collect();
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let std = (values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / n).sqrt();
        assert!((mean - 2.02).abs() < 3e-4, "mean {mean}");
        assert!((std - 0.02).abs() < 2e-4, "std {std}");
    }

    #[test]
    fn resolution_quantises_to_whole_steps() {
        let error = SensorError { noise_std: 0.1, resolution: 0.25, ..SensorError::default() };
        assert!(readings(error, 1.1, 100).into_iter().flatten().all(|v| (v * 4.0).fract() == 0.0));
    }

    #[test]
    fn dropout_rate_matches_setting() {
        let error = SensorError { dropout: 0.1, ..SensorError::default() };
        let missing = readings(error, 1.0, 50_000).iter().filter(|v| v.is_none()).count();
        assert!((4_700..5_300).contains(&missing), "{missing}");
    }
}
