"""Other identification methods for the motion simulator, run in a separate Python environment.

`python identify_others.py DATA.npz` prints a line of JSON. DATA has command and reading [m], period [s], the
averaged response (frequency [Hz], complex), and frequencies `at` [Hz]. Each method returns its response at
these frequencies, its delay if the model has a delay parameter, and its computing time. Discrete models have
a delay of whole periods; the delay with the best prediction is used.
"""

import contextlib
import json
import os
import sys
import time
import warnings

import numpy as np

DELAYS = range(2, 7)
BLOCKS, THINNED = 10, 10  # rows of the Hankel matrices of N4SID; only every `THINNED`-th row is used
ROWS = {"OE": 2_000, "ARX": 20_000}  # rows that each method processes within a minute


def parametric(data, method):
    """Fit a second-order ARX or output-error model; take the delay [periods] with the best prediction."""
    from sippy_unipi import system_identification

    u, y = data["command"][None, : ROWS[method]], data["reading"][None, : ROWS[method]]
    tried = []
    for delay in DELAYS:
        orders = {"ARX_orders": [2, 2, delay]} if method == "ARX" else {"OE_orders": [2, 2, delay]}
        # The solver requires numbers of order 1.
        model = system_identification(1e3 * y, 1e3 * u, method, tsample=1.0, max_iterations=100, **orders)
        residuals = np.ravel(model.Yid)[50:] - 1e3 * y[0, 50:]
        tried.append((float(residuals @ residuals), delay, model.G))
    _, delay, model = min(tried, key=lambda one: one[0])
    z = np.exp(2j * np.pi * data["at"] * data["period"])
    return [complex(np.squeeze(model(one))) for one in z], float(delay * data["period"])


def subspace(data):
    """Fit an N4SID model whose states include the delay.

    Only every tenth row is used, because successive states at 1 kHz are almost equal.
    """
    import pandas
    from nfoursid.nfoursid import NFourSID

    rows = slice(0, None, THINNED)
    frame = pandas.DataFrame({"u": 1e3 * data["command"][rows], "y": 1e3 * data["reading"][rows]})
    identified = NFourSID(frame, output_columns=["y"], input_columns=["u"], num_block_rows=BLOCKS)
    identified.subspace_identification()
    model, _ = identified.system_identification(rank=4)
    z = np.exp(2j * np.pi * data["at"] * THINNED * data["period"])
    eye = np.eye(len(model.a))
    return [
        complex((model.c @ np.linalg.solve(one * eye - model.a, model.b) + model.d)[0, 0]) for one in z
    ], None


def vectors(data):
    """Fit a sum of poles, which also represents the delay, to the averaged response (vector fitting)."""
    import skrf
    from skrf.vectorFitting import VectorFitting

    frequency = skrf.Frequency.from_f(data["frequency"], unit="hz")
    network = skrf.Network(frequency=frequency, s=data["response"].reshape(-1, 1, 1))
    fitted = VectorFitting(network)
    fitted.vector_fit(n_poles_real=0, n_poles_cmplx=3, enforce_dc=False)
    return [complex(one) for one in fitted.get_model_response(0, 0, data["at"])], None


def main():
    data = dict(np.load(sys.argv[1]))
    methods = {
        "sippy ARX": lambda: parametric(data, "ARX"),
        "sippy OE": lambda: parametric(data, "OE"),
        "nfoursid N4SID": lambda: subspace(data),
        "scikit-rf vector fitting": lambda: vectors(data),
    }
    responses = {}
    warnings.simplefilter("ignore")
    for name, method in methods.items():
        begin = time.process_time()
        # The packages print progress messages.
        with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
            response, delay = method()
        took = time.process_time() - begin
        responses[name] = {
            "response": [[one.real, one.imag] for one in response],
            "delay": delay,
            "seconds": took,
        }
    sys.stderr.flush()
    print("\n" + json.dumps(responses))


if __name__ == "__main__":
    main()
