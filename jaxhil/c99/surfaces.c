/* Where the mechanism's surfaces are: at 0, and at -clearance where the contact is two-sided. */

/* == Declarations == */

/* By how far a position [m] is beyond a surface [m]: x > 0, x + clearance < 0, or 0 in between. */
double jaxhil_deflection(double position, double clearance);

/* == Definitions == */

double jaxhil_deflection(double position, double clearance) {
    if (position > 0.0) {
        return position;
    }
    const double far = position + clearance;
    return far < 0.0 ? far : 0.0;
}
