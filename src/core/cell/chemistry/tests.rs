//! Models from labels: every chemistry has one, and its curve is that of cells.

use super::*;

#[test]
fn print_priors() {
    for (chemistry, name) in Chemistry::ALL {
        let label = Label::usual(chemistry, 3.0);
        let curve = label.curve().expect(name);
        let (modes, rest) = curve.modes_v();
        println!("{name} {:?}", curve.electrodes);
        for s in 0..SOC.len() {
            println!(
                "{:.2} {:.3} sd {:.1} m1 {:.1} m2 {:.1} rest {:.1}",
                SOC[s], curve.mean_v[s], 1e3 * curve.covariance[(s, s)].sqrt(), 1e3 * modes[0][s], 1e3 * modes[1][s], 1e3 * rest[s]
            );
        }
    }
}
