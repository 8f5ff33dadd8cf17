"""The model as discrete-time dynamics with outputs, noise, delay and derivatives.

Modules:
    plant: The dynamics with their derivatives.
    dynamics: The dynamics F and h at theta: rollouts, projection, models.
    derivatives: All derivatives of a plant in one object, from the following modules.
    mixed_derivatives: Mixed second derivatives of F and h.
    step_derivatives: First derivatives of F and h.
    closed_form_derivatives: The same without steps of the engine, where the plant allows it.
    batch: Many MuJoCo simulations in one call, and observations at their engine steps.
    laws: The same with control laws that compute controls from a log and from the state.
    state_space: Differences and moves of states on the configuration space.
    outputs: Which components of the state and which sensors are measured.
    noise: Covariance and sampling of the measurements, whitening.
    delay: Time delay of the outputs.
    active_constraints: Contacts, limits, friction and clamps that act along a trajectory.
"""

import lazy_loader

# A name is imported from its module, which `__init__.pyi` states, when it is used first.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
