/* What the policy reads: of each candidate (the newcomer last), and of the context. */
@SLOT_FIELDS@
@CONTEXT_FIELDS@

