<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|Fields|Forms|AttributeTable">
  <renderer-v2 type="graduatedSymbol" graduatedMethod="GraduatedColor" symbollevels="0" referencescale="-1" enableorderby="0" attr="if(&quot;beyond&quot;, 9, &quot;error_m&quot;)" forceraster="0">
    <ranges>
      <range lower="0.000000" upper="0.100000" label="up to 0.1 m" symbol="0" render="true" />
      <range lower="0.100000" upper="0.250000" label="0.1 to 0.25 m" symbol="1" render="true" />
      <range lower="0.250000" upper="0.500000" label="0.25 to 0.5 m" symbol="2" render="true" />
      <range lower="0.500000" upper="1.000000" label="0.5 to 1 m" symbol="3" render="true" />
      <range lower="1.000000" upper="1.500000" label="1 to 1.5 m" symbol="4" render="true" />
      <range lower="1.500000" upper="1000000.000000" label="no reference within 1.5 m" symbol="5" render="true" />
    </ranges>
    <symbols>
      <symbol type="line" clip_to_extent="1" name="0" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="253,231,37,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="1.1" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
        </layer>
      </symbol>
      <symbol type="line" clip_to_extent="1" name="1" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="122,209,81,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="1.1" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
        </layer>
      </symbol>
      <symbol type="line" clip_to_extent="1" name="2" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="34,168,132,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="1.1" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
        </layer>
      </symbol>
      <symbol type="line" clip_to_extent="1" name="3" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="42,120,142,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="1.1" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
        </layer>
      </symbol>
      <symbol type="line" clip_to_extent="1" name="4" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="68,1,84,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="1.1" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
        </layer>
      </symbol>
      <symbol type="line" clip_to_extent="1" name="5" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleLine" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="round" name="capstyle" />
            <Option type="QString" value="round" name="joinstyle" />
            <Option type="QString" value="213,94,0,255" name="line_color" />
            <Option type="QString" value="solid" name="line_style" />
            <Option type="QString" value="1.1" name="line_width" />
            <Option type="QString" value="MM" name="line_width_unit" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <aliases>
    <alias name="Element" field="element_id" />
    <alias name="Class" field="class" />
    <alias name="Error (m)" field="error_m" />
    <alias name="No reference near" field="beyond" />
  </aliases>
  <attributetableconfig actionWidgetStyle="dropDown" sortOrder="0" sortExpression="">
    <columns>
      <column type="field" name="element_id" hidden="0" width="-1" />
      <column type="field" name="class" hidden="0" width="-1" />
      <column type="field" name="error_m" hidden="0" width="-1" />
      <column type="field" name="beyond" hidden="0" width="-1" />
      <column type="field" name="fid" hidden="1" width="-1" />
      <column type="actions" hidden="1" width="-1" />
    </columns>
  </attributetableconfig>
  <layerGeometryType>1</layerGeometryType>
</qgis>
