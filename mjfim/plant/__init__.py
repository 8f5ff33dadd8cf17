"""The model as discrete-time dynamics with outputs, noise, delay and derivatives.

Modules:
    plant: The dynamics with all their derivatives in one object.
    dynamics: The dynamics F and h at theta: rollouts, projection, models.
    first_derivatives: First derivatives of F and h, in closed form or by steps of the engine.
    mixed_derivatives: Mixed second derivatives of F and h.
    closed_form: Derivatives of samples without steps of the engine, where the plant allows it.
    rigid_body_motion: Inverse dynamics of rigid bodies, and its derivatives.
    equation_of_motion: The equation of motion of an engine step, and its affine forces.
    batch: Many MuJoCo simulations in one call, and observations at their engine steps.
    closed_loop: The same with control laws that compute controls from a log and from the state.
    running_law: What these laws receive, remember and compute at a tick.
    state_space: Differences and moves of states on the configuration space.
    outputs: Which components of the state and which sensors are measured, their noise and delay.
    active_constraints: Contacts, limits, friction and clamps that act along a trajectory.
"""

import lazy_loader

# A name is imported from its module, which `__init__.pyi` states, when it is used first.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
