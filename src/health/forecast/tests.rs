//! Histories made up, and what must be told of them.

use super::*;

/// Feeds a fade: `capacity(efc)` at every `step` cycles, one cycle a quarter of a day.
fn fed(capacity: impl Fn(f64) -> f64, step: f64, until: f64) -> Forecast {
    let mut forecast = Forecast::new(Axis::Cycles, 2.0);
    let mut efc = 0.0;
    while efc <= until {
        let passed = if efc == 0.0 { Passed::default() } else { passed(step) };
        let reading = Reading { capacity_ah: capacity(efc), variance_ah2: 1e-5, shared_variance_ah2: 0.0 };
        forecast.update(passed, Some(reading));
        efc += step;
    }
    forecast
}

fn passed(cycles: f64) -> Passed {
    Passed { cycles, days: 0.25 * cycles, rest_days: 0.0 }
}

#[test]
fn a_straight_fade_is_continued() {
    let forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let life = forecast.remaining(1.5).expect("enough is known");
    let cycles = life.cycles.expect("cycles are counted");
    // 1.8 Ah left, 0.3 Ah to go.
    assert!((cycles.median - 150.0).abs() < 10.0, "{cycles:?}");
    assert!(cycles.low < 150.0 && cycles.high > 150.0 && cycles.high < 6.0 * cycles.low, "{cycles:?}");
    let days = life.days.expect("the rate of use is known");
    assert!((days.median / cycles.median - 0.25).abs() < 1e-9, "{days:?}");
}

#[test]
fn the_same_fade_ten_times_slower_lasts_ten_times_longer() {
    let fast = fed(|efc| 2.0 - 0.002 * efc, 10.0, 150.0);
    let slow = fed(|efc| 2.0 - 0.0002 * efc, 100.0, 1500.0);
    let median = |forecast: &Forecast| forecast.remaining(1.5).expect("enough").cycles.expect("cycles").median;
    assert!((median(&slow) / median(&fast) - 10.0).abs() < 1.0, "{} {}", median(&slow), median(&fast));
}

#[test]
fn readings_in_one_cycle_are_not_as_many_readings() {
    let noisy = |efc: f64| 2.0 - 0.002 * efc;
    let (few, many) = (fed(noisy, 1.0, 60.0), fed(noisy, 0.05, 60.0));
    let (few_std, many_std) = (few.rate_ah().1, many.rate_ah().1);
    assert!(many_std > 0.6 * few_std, "{many_std} {few_std}");
}

#[test]
fn a_bump_after_rest_is_not_taken_for_the_end_of_fade() {
    let mut forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 99.0);
    let before = forecast.rate_ah().0;
    let rested = Passed { cycles: 1.0, days: 5.0, rest_days: 4.8 };
    let reading = Reading { capacity_ah: 1.88, variance_ah2: 1e-5, shared_variance_ah2: 0.0 };
    forecast.update(rested, Some(reading));
    assert!((forecast.rate_ah().0 / before - 1.0).abs() < 0.2, "{:?} {before}", forecast.rate_ah());
    assert!(forecast.level_ah().0 < 1.84, "{:?}", forecast.level_ah());
}

#[test]
fn nothing_is_told_of_few_readings_or_of_no_fade() {
    assert_eq!(Forecast::new(Axis::Cycles, 2.0).remaining(1.5), Err(TooThin::Readings { found: 0 }));
    assert_eq!(fed(|efc| 2.0 - 0.01 * efc, 1.0, 3.0).remaining(1.5), Err(TooThin::Readings { found: 4 }));
    let flat = fed(|_| 2.0, 1.0, 300.0).remaining(1.5);
    assert!(matches!(flat, Err(TooThin::Fade { .. })), "{flat:?}");
    let rising = fed(|efc| 2.0 + 0.001 * efc, 1.0, 100.0).remaining(1.5);
    assert!(matches!(rising, Err(TooThin::Fade { .. })), "{rising:?}");
}

#[test]
fn below_the_threshold_nothing_remains() {
    let life = fed(|efc| 2.0 - 0.004 * efc, 1.0, 150.0).remaining(1.6).expect("enough is known");
    assert_eq!(life.cycles.map(|cycles| (cycles.low, cycles.median, cycles.high)), Some((0.0, 0.0, 0.0)));
}

#[test]
fn what_all_readings_share_widens_the_interval() {
    let mut forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let width = |forecast: &Forecast| {
        let cycles = forecast.remaining(1.7).expect("enough").cycles.expect("cycles");
        cycles.high - cycles.low
    };
    let before = width(&forecast);
    let reading = Reading { capacity_ah: 1.798, variance_ah2: 1e-5, shared_variance_ah2: 0.0016 };
    forecast.update(passed(1.0), Some(reading));
    assert!(width(&forecast) > 1.1 * before, "{} {before}", width(&forecast));
}

#[test]
fn the_axis_of_days_tells_days_alone() {
    let mut forecast = Forecast::new(Axis::Days, 2.0);
    for day in 0..12 {
        let days = if day == 0 { 0.0 } else { 5.0 };
        let reading = Reading { capacity_ah: 2.0 - 0.05 * f64::from(day), variance_ah2: 0.0, shared_variance_ah2: 0.0 };
        forecast.update(Passed { days, ..Passed::default() }, Some(reading));
    }
    let life = forecast.remaining(1.2).expect("enough is known");
    assert_eq!(life.cycles, None);
    // 1.45 Ah left, 0.25 Ah to go at 0.01 Ah a day.
    assert!(life.days.is_some_and(|days| (days.median - 25.0).abs() < 5.0), "{life:?}");
}

#[test]
fn use_without_a_reading_is_use_all_the_same() {
    let mut forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let before = forecast.remaining(1.5).expect("enough").cycles.expect("cycles").median;
    (0..50).for_each(|_| forecast.update(passed(1.0), None));
    let after = forecast.remaining(1.5).expect("enough").cycles.expect("cycles").median;
    assert!((before - after - 50.0).abs() < 8.0, "{before} {after}");
}

#[test]
fn the_fan_passes_the_threshold_when_the_forecast_says() {
    let forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 100.0);
    let cycles = forecast.remaining(1.6).expect("enough").cycles.expect("cycles");
    let fan = forecast.fan(2.0 * cycles.median, 3).expect("enough is known");
    assert!((fan[1].median_ah - 1.6).abs() < 1e-6, "{fan:?}");
    assert!(fan[2].low_ah < fan[2].median_ah && fan[2].median_ah < fan[2].high_ah);
    assert!(fan[0].high_ah - fan[0].low_ah < fan[2].high_ah - fan[2].low_ah);
}

#[test]
fn it_is_the_same_after_being_stored() {
    let forecast = fed(|efc| 2.0 - 0.002 * efc, 1.0, 37.0);
    let stored = serde_json::to_string(&forecast).expect("writes");
    assert_eq!(serde_json::from_str::<Forecast>(&stored).expect("reads"), forecast);
    assert!(stored.len() < 600, "{}", stored.len());
}

#[test]
fn any_readings_leave_a_usable_covariance() {
    let mut forecast = Forecast::new(Axis::Cycles, 2.0);
    for k in 0..2000_u32 {
        let capacity_ah = [2.0, 0.01, 3.9, f64::NAN, 1.0][(k % 5) as usize];
        let passed = Passed { cycles: f64::from(k % 7) * 3.0, days: f64::from(k % 3) * 100.0, rest_days: 50.0 };
        forecast.update(passed, Some(Reading { capacity_ah, variance_ah2: 0.0, shared_variance_ah2: 0.0 }));
        assert!((0..N).all(|i| forecast.p[i][i] > 0.0 && forecast.x[i].is_finite()), "{k} {forecast:?}");
        let _ = forecast.remaining(1.0);
    }
}
