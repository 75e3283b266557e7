-- Views for fleet questions over the tables of `packwatch fleet merge`. DuckDB and Spark SQL give the same results.
--
-- Needs views or tables `vehicles`, `half_cycles` and `alarms` over the files of these names. `log` is the vehicle; cells count from 0.
--
-- | view | question |
-- | --- | --- |
-- | not_replayed | which vehicles could not be replayed, and why |
-- | usage | how is each vehicle used: cycles per day, charge, temperature |
-- | capacity_of_cells | how much capacity does each cell have left |
-- | capacity_by_cycles | how does capacity fall with equivalent full cycles: quantiles over cells |
-- | capacity_by_month | how does capacity fall with months since the first record |
-- | resistance_by_cycles | how does resistance rise with equivalent full cycles |
-- | alarms_by_rule | which alarms were raised, how often, in how many vehicles |
-- | first_alarms | when was each alarm first raised in each vehicle |
-- | alarm_leads | how long before the weakest cell fell below 80 % of the rated capacity was the first capacity alarm raised |
-- | cell_outliers | which cells differ from their pack |
-- | pack_outliers | which packs differ from the fleet |
-- | packs_to_call_in | which packs need a workshop, and why |
-- | thresholds | what would a capacity threshold cost: vehicles alarmed, and alarmed vehicles that later rose above it again |

CREATE OR REPLACE TEMPORARY VIEW not_replayed AS
SELECT log, error FROM vehicles WHERE error IS NOT NULL;

-- Each half-cycle with the cell's capacity relative to the rated capacity.
CREATE OR REPLACE TEMPORARY VIEW relative_capacity AS
SELECT
    h.log, cell, time, since_start_s, full_cycles, charge_ah, mean_temperature_c, capacity_ah, resistance_ratio, remaining_cycles_low,
    capacity_ah / rated_ah AS soh,
    row_number() OVER (PARTITION BY h.log, cell ORDER BY time DESC) AS from_last
FROM half_cycles h JOIN vehicles v ON v.log = h.log;

CREATE OR REPLACE TEMPORARY VIEW usage AS
SELECT
    h.log,
    max(v.days) AS days,
    max(h.full_cycles) AS full_cycles,
    max(h.full_cycles) / max(v.days) AS full_cycles_a_day,
    sum(h.charge_ah) / max(v.cells) AS charge_ah,
    avg(h.mean_temperature_c) AS mean_temperature_c
FROM half_cycles h JOIN vehicles v ON v.log = h.log
WHERE v.days > 0
GROUP BY h.log;

CREATE OR REPLACE TEMPORARY VIEW capacity_of_cells AS
SELECT
    log, cell, capacity_ah, soh, resistance_ratio, remaining_cycles_low, full_cycles, time
FROM relative_capacity WHERE from_last = 1;

CREATE OR REPLACE TEMPORARY VIEW capacity_by_cycles AS
SELECT
    10 * floor(full_cycles / 10) AS full_cycles_from,
    count(DISTINCT log) AS vehicles,
    percentile_cont(0.05) WITHIN GROUP (ORDER BY soh) AS soh_low,
    percentile_cont(0.5) WITHIN GROUP (ORDER BY soh) AS soh_median,
    percentile_cont(0.95) WITHIN GROUP (ORDER BY soh) AS soh_high
FROM relative_capacity WHERE full_cycles IS NOT NULL
GROUP BY 10 * floor(full_cycles / 10);

CREATE OR REPLACE TEMPORARY VIEW capacity_by_month AS
SELECT
    floor(since_start_s / 2629800) AS months_from,
    count(DISTINCT log) AS vehicles,
    percentile_cont(0.05) WITHIN GROUP (ORDER BY soh) AS soh_low,
    percentile_cont(0.5) WITHIN GROUP (ORDER BY soh) AS soh_median,
    percentile_cont(0.95) WITHIN GROUP (ORDER BY soh) AS soh_high
FROM relative_capacity
GROUP BY floor(since_start_s / 2629800);

CREATE OR REPLACE TEMPORARY VIEW resistance_by_cycles AS
SELECT
    10 * floor(full_cycles / 10) AS full_cycles_from,
    percentile_cont(0.05) WITHIN GROUP (ORDER BY resistance_ratio) AS resistance_low,
    percentile_cont(0.5) WITHIN GROUP (ORDER BY resistance_ratio) AS resistance_median,
    percentile_cont(0.95) WITHIN GROUP (ORDER BY resistance_ratio) AS resistance_high
FROM relative_capacity WHERE full_cycles IS NOT NULL
GROUP BY 10 * floor(full_cycles / 10);

CREATE OR REPLACE TEMPORARY VIEW alarms_by_rule AS
SELECT rule, severity, count(*) AS raised, count(DISTINCT log) AS vehicles
FROM alarms WHERE change = 'raised'
GROUP BY rule, severity;

CREATE OR REPLACE TEMPORARY VIEW first_alarms AS
SELECT log, rule, severity, min(time) AS time, min(since_start_s) / 86400 AS days
FROM alarms WHERE change = 'raised'
GROUP BY log, rule, severity;

CREATE OR REPLACE TEMPORARY VIEW alarm_leads AS
SELECT a.log, a.severity, a.days AS alarmed_days, e.days AS ended_days, e.days - a.days AS lead_days
FROM first_alarms a
JOIN (SELECT log, min(since_start_s) / 86400 AS days FROM relative_capacity WHERE soh < 0.8 GROUP BY log) e ON e.log = a.log
WHERE a.rule = 'capacity_low';

CREATE OR REPLACE TEMPORARY VIEW pack_medians AS
SELECT log, percentile_cont(0.5) WITHIN GROUP (ORDER BY capacity_ah) AS median_ah FROM capacity_of_cells GROUP BY log;

CREATE OR REPLACE TEMPORARY VIEW cell_differences AS
SELECT c.log, c.cell, c.capacity_ah, m.median_ah, c.capacity_ah / m.median_ah - 1 AS differs
FROM capacity_of_cells c JOIN pack_medians m ON m.log = c.log;

-- Outliers differ from the pack by more than three robust deviations (1.4826 median absolute deviations) and more than 2 %.
CREATE OR REPLACE TEMPORARY VIEW cell_outliers AS
SELECT d.log, d.cell, d.capacity_ah, d.median_ah, d.differs
FROM cell_differences d
JOIN (
    SELECT log, percentile_cont(0.5) WITHIN GROUP (ORDER BY abs(differs)) AS deviation FROM cell_differences GROUP BY log
) s ON s.log = d.log
WHERE abs(d.differs) > 3 * 1.4826 * s.deviation AND abs(d.differs) > 0.02;

-- The weakest cell of each vehicle.
CREATE OR REPLACE TEMPORARY VIEW weakest AS
SELECT log, min(soh) AS soh, min(remaining_cycles_low) AS remaining_cycles_low, max(resistance_ratio) AS resistance_ratio
FROM capacity_of_cells GROUP BY log;

CREATE OR REPLACE TEMPORARY VIEW pack_differences AS
SELECT w.log, w.soh, m.median_soh, w.soh - m.median_soh AS differs
FROM weakest w CROSS JOIN (SELECT percentile_cont(0.5) WITHIN GROUP (ORDER BY soh) AS median_soh FROM weakest) m;

CREATE OR REPLACE TEMPORARY VIEW pack_outliers AS
SELECT d.log, d.soh, d.median_soh, d.differs
FROM pack_differences d
CROSS JOIN (SELECT percentile_cont(0.5) WITHIN GROUP (ORDER BY abs(differs)) AS deviation FROM pack_differences) s
WHERE abs(d.differs) > 3 * 1.4826 * s.deviation AND abs(d.differs) > 0.02;

-- Alarms at the end of each vehicle's log.
CREATE OR REPLACE TEMPORARY VIEW last_alarms AS
SELECT log, rule, severity, cell, active FROM (
    SELECT
        log, rule, severity, cell, active,
        row_number() OVER (PARTITION BY log, rule, severity, cell ORDER BY time DESC, occurrences DESC) AS from_last
    FROM alarms
) ordered WHERE from_last = 1;

CREATE OR REPLACE TEMPORARY VIEW packs_to_call_in AS
SELECT
    w.log, w.soh, w.remaining_cycles_low,
    w.soh < 0.8 AS is_worn,
    coalesce(w.remaining_cycles_low < 50, false) AS ends_soon,
    coalesce(a.severe > 0, false) AS has_severe_alarm
FROM weakest w
LEFT JOIN (SELECT log, count(*) AS severe FROM last_alarms WHERE active AND severity = 'severe' GROUP BY log) a ON a.log = w.log
WHERE w.soh < 0.8 OR coalesce(w.remaining_cycles_low < 50, false) OR coalesce(a.severe > 0, false);

CREATE OR REPLACE TEMPORARY VIEW thresholds AS
SELECT
    t.threshold,
    count(DISTINCT CASE WHEN r.soh < t.threshold THEN r.log END) AS vehicles_below,
    count(DISTINCT CASE WHEN r.soh < t.threshold AND w.soh >= t.threshold THEN r.log END) AS above_again
FROM (VALUES (0.7e0), (0.75e0), (0.8e0), (0.85e0), (0.9e0), (0.95e0)) AS t (threshold)
CROSS JOIN relative_capacity r
JOIN weakest w ON w.log = r.log
GROUP BY t.threshold;
