"""The model as discrete-time dynamics with outputs, noise, delay and derivatives.

Modules:
    plant: The dynamics F and h at theta: rollouts, projection, models.
    derivatives: All derivatives of a plant in one object, from the following modules.
    rollout_derivatives: Sensitivities of whole rollouts.
    step_derivatives: First derivatives of F and h.
    mixed_derivatives: Mixed second derivatives of F and h.
    difference_steps: Steps of the differences.
    batch: Many MuJoCo simulations in one call, and observations at their engine steps.
    closed_loop: The same with control laws that compute controls from a log and from the state.
    running_law: Control laws at their ticks, and what they remember.
    state_space: Differences and moves of states on the configuration space.
    outputs: Which components of the state and which sensors are measured.
    noise: Covariance and sampling of the measurements, whitening.
    delay: Time delay of the outputs.
    active_constraints: Contacts, limits, friction and clamps that act along a trajectory.
"""

import lazy_loader

# A name is imported from its module, which `__init__.pyi` states, when it is used first.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
