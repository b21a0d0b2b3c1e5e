"""Python interface that the README promises, line by line, with small numbers: run by `test_api_tuning`."""

import jax.numpy as jnp
import jaxhil
import tuning

mechanism = jaxhil.load("varying", {"rig.force_sensor.delay": 0.0035})   # built-in name or path; overrides as --set
run = jaxhil.simulate(mechanism, "response_error")     # gains: None (literature), a dict, a setting's name, or a gain file's path
print(run.contacts[0].restitution, run.contacts[0].error, run.status, run.gains["phase_lead"])
print(run.time[-1], run.force_measured.max(), run.force_command.max(), run.position_desired.max(), run.contact[-1])
run.to_csv("run.csv")
run.plot("run.png")

result = tuning.tune(mechanism, "response_error", scenarios=4, starts=1, objective="rms", seed=0)
print(result.gains["phase_lead"], result.figures["tuned"].rms, result.verdict)
result.save("gains.json")

study = tuning.sweep("gains.json", scenarios=64, limit=0.02)          # folder=None keeps nothing on disk
print(study.failure_probability, study.interval.low, study.interval.high, study.table.num_rows)

board = tuning.compare(mechanism, ["phase_lead", "response_error"], scenarios=4, judged=8)
print(board.figures["response_error"]["tuned"].rms)
tuning.export(result, "bundle", sweep=study)
print(tuning.verify("bundle").good)

slope = jaxhil.jacobian(mechanism, "response_error", of="restitution", by=["rig.force_sensor.delay", "gains.phase_lead"])
print(slope["rig.force_sensor.delay"])                  # one number a contact
worst = tuning.tune(mechanism, "phase_lead", scenarios=4, starts=1, objective=lambda metrics: jnp.abs(metrics.error).max())
batch = tuning.tune([jaxhil.load(name) for name in ("varying", "rig-300kg")], "phase_lead", scenarios=4, starts=1)
print([one.figures["tuned"].rms for one in batch])
