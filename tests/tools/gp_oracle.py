"""Runs scikit-learn's Gaussian process regression with an exponential kernel and fixed hyperparameters. It is the
reference for tests/integration/gp_peer.rs.

Reads one command per line from standard input; each answer is one line on standard output:
  make N DIR   draws N rows of 3 inputs and 2000 queries, writes DIR/rows.f64 (inputs, targets, queries; little endian)
  fit          fits; answers wall-clock and processor time, s
  predict      predicts; writes DIR/mean.f64 and DIR/std.f64; answers like fit
Exit status 77 if scikit-learn is not installed. OPENBLAS_NUM_THREADS sets the number of threads.
"""
import sys
import time

try:
    import numpy as np
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import Matern
except ImportError:
    sys.exit(77)

QUERIES = 2000


def timed(work):
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, f"{time.perf_counter() - wall} {time.process_time() - cpu}"


def main():
    for line in sys.stdin:
        command, *arguments = line.split()
        if command == "make":
            n, folder = int(arguments[0]), arguments[1]
            random = np.random.default_rng(n)
            x, queries = random.uniform(-2, 2, (n, 3)), random.uniform(-2, 2, (QUERIES, 3))
            y = np.sin(x[:, 0]) + 0.5 * np.cos(2 * x[:, 1]) * x[:, 2] + random.normal(0, 0.1, n)
            np.concatenate([x.ravel(), y, queries.ravel()]).astype("<f8").tofile(f"{folder}/rows.f64")
            answer = "made"
        elif command == "fit":
            model = GaussianProcessRegressor(kernel=Matern(length_scale=1.5, nu=0.5), alpha=0.01, optimizer=None)
            _, answer = timed(lambda: model.fit(x, y))
        elif command == "predict":
            (mean, deviation), answer = timed(lambda: model.predict(queries, return_std=True))
            mean.astype("<f8").tofile(f"{folder}/mean.f64")
            deviation.astype("<f8").tofile(f"{folder}/std.f64")
        else:
            sys.exit(f"unknown command {command}")
        print(answer, flush=True)


main()
