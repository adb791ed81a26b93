"""The fields of a compiled model in which tasks may differ, and those that must be equal, by their names in MJX.

MJX's own dataclasses hold the same, but importing them takes seconds, and runs of MuJoCo's C engine do not need them.
"""

# Fields of the model that never reach the dynamics: statistics, and what only a renderer reads.
UNUSED = ("stat", "cam_", "light_", "mat_", "tex_", "name", "_", "signature", "geom_rgba")

# What MJX traces. It keeps the sizes of sites out of that, but reads them as values only (touch sensors).
VARIABLE = tuple(
    """
    site_size
    qpos0 qpos_spring body_pos body_quat body_ipos body_iquat body_mass body_subtreemass body_inertia body_gravcomp
    body_invweight0 jnt_solref jnt_solimp jnt_pos jnt_axis jnt_stiffness jnt_stiffnesspoly jnt_range jnt_actfrcrange
    jnt_margin dof_solref dof_solimp dof_frictionloss dof_armature dof_damping dof_dampingpoly dof_invweight0 dof_M0
    geom_matid geom_solmix geom_solref geom_solimp geom_size geom_aabb geom_rbound geom_pos geom_quat geom_friction
    geom_margin geom_gap site_pos site_quat hfield_data pair_solref pair_solreffriction pair_solimp pair_margin
    pair_gap pair_friction eq_solref eq_solimp eq_data tendon_solref_lim tendon_solimp_lim tendon_solref_fri
    tendon_solimp_fri tendon_range tendon_actfrcrange tendon_margin tendon_stiffness tendon_stiffnesspoly
    tendon_damping tendon_dampingpoly tendon_armature tendon_frictionloss tendon_lengthspring tendon_length0
    tendon_invweight0 actuator_dynprm actuator_gainprm actuator_biasprm actuator_ctrlrange actuator_forcerange
    actuator_actrange actuator_gear actuator_cranklength actuator_acc0 actuator_lengthrange opt.tolerance
    opt.ls_tolerance opt.impratio opt.gravity opt.density opt.viscosity opt.magnetic opt.wind opt.timestep
    """.split()
)
# What decides which program MJX becomes.
FIXED = tuple(
    """
    nq nv nu na nbody njnt ngeom nsite ncam nlight nflex nmesh nmeshvert nmeshnormal nmeshtexcoord nmeshface
    nmeshgraph nmeshpoly nmeshpolyvert nmeshpolymap nhfield nhfielddata ntex ntexdata nmat npair nexclude neq
    ntendon nwrap nsensor nnumeric ntuple nkey nmocap nM nB nC nD nJmom nJten ngravcomp flg_gravcomp flg_surfacevel
    nuserdata nsensordata npluginstate nhistory body_parentid body_mocapid body_rootid body_weldid body_jntnum
    body_jntadr body_sameframe body_dofnum body_dofadr body_treeid body_geomnum body_geomadr body_simple body_margin
    body_contype body_conaffinity jnt_type jnt_qposadr jnt_dofadr jnt_bodyid jnt_limited jnt_actfrclimited
    jnt_actgravcomp dof_bodyid dof_jntid dof_parentid dof_treeid dof_Madr dof_simplenum M_rowadr M_rownnz M_colind
    geom_type geom_contype geom_conaffinity geom_condim geom_bodyid geom_sameframe geom_dataid geom_group
    geom_priority geom_fluid site_type site_bodyid site_sameframe mesh_vertadr mesh_vertnum mesh_faceadr mesh_bvhadr
    mesh_bvhnum mesh_octadr mesh_octnum mesh_normaladr mesh_normalnum mesh_graphadr mesh_vert mesh_normal mesh_face
    mesh_graph mesh_pos mesh_quat mesh_texcoordadr mesh_texcoordnum mesh_texcoord flex_vertadr flex_vertnum
    flex_interp flex_vert0 flex_nodeadr flex_nodenum flex_nodebodyid flex_node0 hfield_size hfield_nrow hfield_ncol
    hfield_adr pair_dim pair_geom1 pair_geom2 pair_signature exclude_signature eq_type eq_obj1id eq_obj2id
    eq_objtype eq_active0 tendon_adr tendon_num tendon_limited tendon_actfrclimited wrap_type wrap_objid wrap_prm
    actuator_trntype actuator_dyntype actuator_gaintype actuator_biastype actuator_trnid actuator_actadr
    actuator_actnum actuator_group actuator_ctrllimited actuator_forcelimited actuator_actlimited actuator_actearly
    sensor_type sensor_datatype sensor_needstage sensor_objtype sensor_objid sensor_reftype sensor_refid
    sensor_intprm sensor_dim sensor_adr sensor_cutoff numeric_adr numeric_data tuple_adr tuple_size tuple_objtype
    tuple_objid tuple_objprm key_time key_qpos key_qvel key_act key_mpos key_mquat key_ctrl opt.iterations
    opt.ls_iterations opt.jacobian opt.cone opt.disableflags opt.enableflags opt.integrator opt.solver
    """.split()
)
