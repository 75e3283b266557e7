//! Tests of the forecast with synthetic histories.

use super::*;

/// A forecast that has received the capacity `capacity(efc)` (Ah) after every `step` equivalent full cycles (efc) up to
/// `until`. One cycle takes a quarter of a day.
fn fed(capacity: impl Fn(f64) -> f64, step: f64, until: f64) -> Forecast {
    let mut forecast = Forecast::new(Axis::Cycles, 2.0);
    let mut efc = 0.0;
    while efc <= until {
        let passed = if efc == 0.0 { Usage::default() } else { passed(step) };
        let reading = CapacityReading { capacity_ah: capacity(efc), variance_ah2: 1e-5, shared_variance_ah2: 0.0 };
        forecast.update(passed, Some(reading));
        efc += step;
    }
    forecast
}

fn passed(cycles: f64) -> Usage {
    Usage { cycles, days: 0.25 * cycles, rest_days: 0.0 }
}

#[test]
fn interval_covers_straight_continuation_before_knee() {
    let forecast = fed(|efc| 2.0 - 0.001 * efc, 1.0, 100.0);
    let life = forecast.remaining(1.8).expect("enough is known");
    let cycles = life.cycles.expect("cycles are counted");
    // The cell is 0.1 Ah above the threshold: 100 cycles at the present rate. The median is lower, because most cells
    // fade faster later.
    assert!((75.0..100.0).contains(&cycles.median), "{cycles:?}");
    assert!(cycles.low < 100.0 && cycles.high > 100.0 && cycles.high < 8.0 * cycles.low, "{cycles:?}");
    let days = life.days.expect("the rate of use is known");
    assert!((days.median / cycles.median - 0.25).abs() < 1e-9, "{days:?}");
}

#[test]
fn interval_covers_fade_with_and_without_knee() {
    let forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let cycles = forecast.remaining(1.6).expect("enough is known").cycles.expect("cycles are counted");
    // The cell is 0.2 Ah above the threshold: 100 cycles at the present rate. If the rate grew by a factor of e^0.9 at
    // once, 41 cycles would remain.
    assert!((45.0..90.0).contains(&cycles.median) && cycles.low < 45.0 && cycles.high > 100.0, "{cycles:?}");
}

#[test]
fn tenfold_slower_fade_lasts_tenfold_longer() {
    let fast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 150.0);
    let slow = fed(|efc| 2.0 - 0.0002 * efc, 10.0, 1500.0);
    let median = |forecast: &Forecast| forecast.remaining(1.5).expect("enough").cycles.expect("cycles").median;
    // Typical lives are part of the prior, so the factor is slightly below 10.
    assert!((8.0..11.0).contains(&(median(&slow) / median(&fast))), "{} {}", median(&slow), median(&fast));
}

#[test]
fn readings_within_one_cycle_count_less() {
    // A recovery with a time constant of ten cycles, sampled every 0.05 cycles. The random generator has a fixed seed.
    let (mut seed, mut recovery) = (1_u64, 0.0);
    let recoveries: Vec<f64> = (0..=2000)
        .map(|_| {
            seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            recovery = 0.995 * recovery + 0.006 * ((seed >> 11) as f64 / (1_u64 << 53) as f64 - 0.5);
            recovery
        })
        .collect();
    let noisy = |efc: f64| 2.0 - 0.002 * efc + recoveries[(20.0 * efc).round() as usize];
    let (few, many) = (fed(noisy, 1.0, 100.0), fed(noisy, 0.05, 100.0));
    let (few_std, many_std) = (few.rate_ah().1, many.rate_ah().1);
    // 20 times as many independent readings would divide the deviation by 4.5.
    assert!(many_std > 0.5 * few_std, "{many_std} {few_std}");
}

#[test]
fn noise_is_learned_from_the_readings() {
    let scatter = |size: f64| fed(|efc| 2.0 - 0.0005 * efc + if efc % 2.0 == 0.0 { size } else { 0.0 }, 1.0, 100.0);
    let std = |size: f64| scatter(size).rate_ah().1;
    assert!(std(0.001) < 0.5 * std(0.05), "{} {}", std(0.001), std(0.05));
}

#[test]
fn loss_counts_from_the_highest_level() {
    // The capacity rises by 4 % in 40 cycles, then falls by 4 % in 80 cycles.
    let forecast = fed(|efc| if efc < 40.0 { 2.0 + 0.002 * efc } else { 2.08 - 0.001 * (efc - 40.0) }, 1.0, 120.0);
    assert!((forecast.x[TOP] - 1.04).abs() < 0.01, "{forecast:?}");
    // The cell is 0.2 Ah above the threshold: 200 cycles at the present rate.
    let cycles = forecast.remaining(1.8).expect("enough").cycles.expect("cycles");
    assert!(cycles.low < 100.0 && (80.0..250.0).contains(&cycles.median) && cycles.high > 250.0, "{cycles:?}");
}

#[test]
fn recovery_after_rest_keeps_fade_rate() {
    let mut forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 99.0);
    let before = forecast.rate_ah().0;
    let rested = Usage { cycles: 1.0, days: 5.0, rest_days: 4.8 };
    let reading = CapacityReading { capacity_ah: 1.88, variance_ah2: 1e-5, shared_variance_ah2: 0.0 };
    forecast.update(rested, Some(reading));
    assert!((forecast.rate_ah().0 / before - 1.0).abs() < 0.2, "{:?} {before}", forecast.rate_ah());
    assert!(forecast.level_ah().0 < 1.84, "{:?}", forecast.level_ah());
}

#[test]
fn few_readings_give_no_forecast() {
    assert_eq!(Forecast::new(Axis::Cycles, 2.0).remaining(1.5), Err(InsufficientData::Readings { found: 0 }));
    assert_eq!(fed(|efc| 2.0 - 0.01 * efc, 1.0, 1.0).remaining(1.5), Err(InsufficientData::Readings { found: 2 }));
}

#[test]
fn unseen_fade_gives_wide_interval() {
    for unseen in [fed(|_| 2.0, 1.0, 300.0), fed(|efc| 2.0 + 0.001 * efc, 1.0, 100.0), fed(|_| 2.0, 1.0, 3.0)] {
        let cycles = unseen.remaining(1.5).expect("enough readings").cycles.expect("cycles");
        assert!(cycles.low < 1000.0 && cycles.high > 10.0 * cycles.low && cycles.high.is_finite(), "{cycles:?}");
    }
}

#[test]
fn level_below_threshold_leaves_no_life() {
    let life = fed(|efc| 2.0 - 0.004 * efc, 1.0, 150.0).remaining(1.6).expect("enough is known");
    assert_eq!(life.cycles.map(|cycles| (cycles.low, cycles.median, cycles.high)), Some((0.0, 0.0, 0.0)));
}

#[test]
fn shared_error_widens_the_interval() {
    let mut forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let width = |forecast: &Forecast| {
        let cycles = forecast.remaining(1.7).expect("enough").cycles.expect("cycles");
        cycles.high - cycles.low
    };
    let before = width(&forecast);
    let reading = CapacityReading { capacity_ah: 1.798, variance_ah2: 1e-5, shared_variance_ah2: 0.0016 };
    forecast.update(passed(1.0), Some(reading));
    assert!(width(&forecast) > 1.1 * before, "{} {before}", width(&forecast));
}

#[test]
fn days_axis_gives_days_only() {
    let mut forecast = Forecast::new(Axis::Days, 2.0);
    for day in 0..12 {
        let days = if day == 0 { 0.0 } else { 5.0 };
        let reading =
            CapacityReading { capacity_ah: 2.0 - 0.05 * f64::from(day), variance_ah2: 0.0, shared_variance_ah2: 0.0 };
        forecast.update(Usage { days, ..Usage::default() }, Some(reading));
    }
    let life = forecast.remaining(1.2).expect("enough is known");
    assert_eq!(life.cycles, None);
    // The cell is 0.25 Ah above the threshold and loses 0.01 Ah per day.
    assert!(life.days.is_some_and(|days| (days.median - 25.0).abs() < 5.0), "{life:?}");
}

#[test]
fn use_without_reading_shortens_remaining_life() {
    let mut forecast = fed(|efc| 2.0 - 0.001 * efc, 1.0, 100.0);
    let before = forecast.remaining(1.8).expect("enough").cycles.expect("cycles").median;
    (0..50).for_each(|_| forecast.update(passed(1.0), None));
    let after = forecast.remaining(1.8).expect("enough").cycles.expect("cycles").median;
    // The two forecasts start from different losses, so the difference is not exactly 50 cycles.
    assert!((25.0..58.0).contains(&(before - after)), "{before} {after}");
}

#[test]
fn fan_crosses_threshold_at_forecast_median() {
    let forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let cycles = forecast.remaining(1.6).expect("enough").cycles.expect("cycles");
    let fan = forecast.fan(2.0 * cycles.median, 3).expect("enough is known");
    assert!((fan[1].median_ah - 1.6).abs() < 1e-6, "{fan:?}");
    assert!(fan[2].low_ah < fan[2].median_ah && fan[2].median_ah < fan[2].high_ah);
    assert!(fan[0].high_ah - fan[0].low_ah < fan[2].high_ah - fan[2].low_ah);
}

#[test]
fn stored_forecast_is_restored_unchanged() {
    let forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 37.0);
    let stored = serde_json::to_string(&forecast).expect("writes");
    assert_eq!(serde_json::from_str::<Forecast>(&stored).expect("reads"), forecast);
    assert!(stored.len() < 700, "{}", stored.len());
}

#[test]
fn extreme_readings_keep_covariance_positive() {
    let mut forecast = Forecast::new(Axis::Cycles, 2.0);
    for k in 0..2000_u32 {
        let capacity_ah = [2.0, 0.01, 3.9, f64::NAN, 1.0][(k % 5) as usize];
        let passed = Usage { cycles: f64::from(k % 7) * 3.0, days: f64::from(k % 3) * 100.0, rest_days: 50.0 };
        forecast.update(passed, Some(CapacityReading { capacity_ah, variance_ah2: 0.0, shared_variance_ah2: 0.0 }));
        assert!((0..N).all(|i| forecast.p[i][i] > 0.0 && forecast.x[i].is_finite()), "{k} {forecast:?}");
        let _ = forecast.remaining(1.0);
    }
}

#[test]
fn uncertain_first_reading_hardly_changes_forecast() {
    let median_after = |first_variance_ah2: f64, first_error_ah: f64| {
        let mut forecast = Forecast::new(Axis::Cycles, 2.0);
        for efc in 0..100 {
            let (variance_ah2, error_ah) = if efc == 0 { (first_variance_ah2, first_error_ah) } else { (1e-5, 0.0) };
            let capacity_ah = 2.0 - 0.002 * f64::from(efc) + error_ah;
            let passed = if efc == 0 { Usage::default() } else { passed(1.0) };
            forecast.update(passed, Some(CapacityReading { capacity_ah, variance_ah2, shared_variance_ah2: 0.0 }));
        }
        forecast.remaining(1.5).expect("enough readings").cycles.expect("cycles").median
    };
    let (good, weak) = (median_after(1e-5, 0.0), median_after(4.0, -0.3));
    assert!((weak / good - 1.0).abs() < 0.1, "{good} {weak}");
}

#[test]
fn nightly_rest_does_not_hide_the_fade() {
    let mut forecast = Forecast::new(Axis::Cycles, 2.0);
    for day in 0..400 {
        let passed = Usage { cycles: 0.25, days: 1.0, rest_days: 0.9 };
        let capacity_ah = 2.0 - 0.001 * f64::from(day);
        forecast.update(passed, Some(CapacityReading { capacity_ah, variance_ah2: 1e-4, shared_variance_ah2: 0.0 }));
    }
    let recovery_std = forecast.p[RECOVERY][RECOVERY].sqrt();
    assert!(recovery_std < 1.1 * RECOVERY_IN_REST.hypot(RECOVERY_IN_USE), "{recovery_std}");
    // The cell is 0.1 Ah above the threshold and loses 0.004 Ah per cycle.
    let cycles = forecast.remaining(1.5).expect("enough is known").cycles.expect("cycles");
    assert!(cycles.low < 25.0 && cycles.high > 25.0 && cycles.median > 15.0 && cycles.median < 35.0, "{cycles:?}");
}

#[test]
fn forecast_is_continuous_through_the_threshold() {
    let mut forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let mut before: Option<Remaining> = None;
    for efc in 101..300 {
        let capacity_ah = 2.0 - 0.002 * f64::from(efc);
        forecast
            .update(passed(1.0), Some(CapacityReading { capacity_ah, variance_ah2: 1e-4, shared_variance_ah2: 0.0 }));
        let now = forecast.remaining(1.6).unwrap_or_else(|why| panic!("after {efc} cycles: {why}"));
        let now = now.cycles.expect("cycles");
        if let Some(before) = before {
            let fell = |before: f64, now: f64| (before - now - 1.0).abs() < 0.12 * before + 4.0;
            assert!(fell(before.low, now.low) && fell(before.median, now.median), "{efc}: {before:?} {now:?}");
        }
        before = Some(now);
    }
    assert_eq!(before, Some(Remaining::default()));
}

#[test]
fn cell_below_threshold_without_fade_has_no_life() {
    let forecast = fed(|_| 1.4, 1.0, 30.0);
    let life = forecast.remaining(1.6).expect("known without a fade");
    assert_eq!(life.cycles, Some(Remaining::default()));
    let later = forecast.remaining(1.2).expect("enough readings").cycles.expect("cycles");
    assert!(later.high > 10.0 * later.low, "{later:?}");
}

#[test]
fn fan_starts_with_interval_of_level() {
    let forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let (level, std) = forecast.level_ah();
    let now = forecast.fan(100.0, 2).expect("enough is known")[0];
    assert!((now.low_ah - (level - 1.645 * std)).abs() < 0.02 * std, "{now:?} {level} {std}");
    assert!((now.high_ah - (level + 1.645 * std)).abs() < 0.02 * std, "{now:?} {level} {std}");
}

#[test]
fn long_rest_hardly_changes_recent_use() {
    let mut forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let rested = Usage { cycles: 0.5, days: 300.0, rest_days: 299.9 };
    forecast.update(rested, Some(CapacityReading { capacity_ah: 1.8, variance_ah2: 1e-4, shared_variance_ah2: 0.0 }));
    (0..20).for_each(|_| forecast.update(passed(1.0), None));
    let life = forecast.remaining(1.5).expect("enough is known");
    let days_per_cycle = life.days.expect("days").median / life.cycles.expect("cycles").median;
    // The recent rate of use is an average over about 30 days: the 5 days of the 20 cycles, and 25 days of rest. The
    // other 275 days of rest hardly count.
    assert!((0.25..2.0).contains(&days_per_cycle), "{days_per_cycle}");
}

#[test]
fn one_outlier_moves_the_forecast_little() {
    let mut forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let before = forecast.rate_ah().0;
    forecast
        .update(passed(1.0), Some(CapacityReading { capacity_ah: 0.9, variance_ah2: 1e-6, shared_variance_ah2: 0.0 }));
    assert!((1.7..1.85).contains(&forecast.level_ah().0), "{:?}", forecast.level_ah());
    assert!((forecast.rate_ah().0 / before - 1.0).abs() < 0.5, "{:?} {before}", forecast.rate_ah());
}

#[test]
fn readings_from_one_time_give_no_forecast() {
    let mut forecast = Forecast::new(Axis::Cycles, 2.0);
    for n in 0..8 {
        let capacity_ah = 2.0 - 0.05 * f64::from(n);
        let reading = CapacityReading { capacity_ah, variance_ah2: 1e-6, shared_variance_ah2: 0.0 };
        forecast.update(Usage::default(), Some(reading));
    }
    assert_eq!(forecast.remaining(1.5), Err(InsufficientData::Use));
}

#[test]
fn nan_input_is_ignored_and_stored_nan_rejected() {
    let mut forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 50.0);
    let before = forecast.clone();
    let wild = Usage { cycles: f64::INFINITY, days: f64::NAN, rest_days: f64::NAN };
    let reading = CapacityReading { capacity_ah: 1.9, variance_ah2: 1e-5, shared_variance_ah2: f64::NAN };
    forecast.update(wild, Some(reading));
    assert_eq!((forecast.x, forecast.readings), (before.x, before.readings));
    assert_eq!(before.check(Axis::Cycles), Ok(()));
    assert!(before.check(Axis::Days).is_err());
    type Damage = fn(&mut Forecast);
    let damages: [Damage; 8] = [
        |forecast| forecast.reference_ah = 0.0,
        |forecast| forecast.x[RATE] = f64::NAN,
        |forecast| forecast.p[LEVEL][LEVEL] = -1e-9,
        |forecast| forecast.p[LEVEL][RATE] = 1.0,
        |forecast| forecast.used = -1.0,
        |forecast| forecast.noise_scale = f64::NAN,
        |forecast| forecast.first_level = Some(f64::INFINITY),
        |forecast| forecast.recent[1] = f64::INFINITY,
    ];
    for (number, damage) in damages.into_iter().enumerate() {
        let mut damaged = before.clone();
        damage(&mut damaged);
        assert!(damaged.check(Axis::Cycles).is_err(), "damage {number}");
    }
}
